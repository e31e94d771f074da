"""The photon walk through the medium, from laser spots and lights to the cameras; ground truth and references."""

MOST_CAMERAS = 6  # that one collision or exit connects to (docs/decisions/0051)
