"""Named points of a body: keypoints, markers and joints of other rigs, as places in the canonical rig."""

__all__: list[str] = []
