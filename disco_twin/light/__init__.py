"""disco_twin/light"""

MOST_CAMERAS = 6  # that one collision or exit connects to (docs/decisions/0051)
