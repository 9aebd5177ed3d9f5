"""Animation (paper, section 3.5.1): forward kinematics and linear blend skinning."""
