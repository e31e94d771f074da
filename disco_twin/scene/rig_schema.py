"""The schema of `[rig]` in a scene: the nominal rig, and by which faults the twin's actual rig departs from it."""

from __future__ import annotations

from hw.base.config import Strict
from pipeline.geometry.nominal_rig import RigConfig


class FaultsConfig(Strict):
    """The rig faults of 2004, each with a switch. They act in the twin alone; the pipeline is not given this table."""

    deviation: bool = False  # the actual rig's geometry differs from the nominal one
    warm_up: bool = False
    blue_noise: bool = False
    mode_hop: bool = False
    speckle: bool = False
    flare: bool = False
    scanner: bool = False  # the scan is made from a cloud of points, with the scanner's errors


class TwinRigConfig(RigConfig):
    """The nominal rig and the faults of the twin's actual one."""

    faults: FaultsConfig = FaultsConfig()

    def nominal(self) -> RigConfig:
        """What the pipeline is given: the rig without the twin's secrets."""
        return RigConfig(**{name: getattr(self, name) for name in RigConfig.model_fields})
