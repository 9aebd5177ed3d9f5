"""Skeletal abstraction (paper, section 3.4): the canonical skeleton fitted to any body shape."""
