"""`disco-twin budget OUT`: where a run's relighting error comes from, each part of the way made exact in turn."""
