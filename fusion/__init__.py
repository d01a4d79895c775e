"""What we conclude: preintegration, filter, navigator, tracks, command."""

from typing import TYPE_CHECKING

from stario.sequences.lazy import lazy_attributes

if TYPE_CHECKING:
    from stario.fusion.config import FilterConfig as FilterConfig
    from stario.fusion.config import NavigatorConfig as NavigatorConfig
    from stario.fusion.config import read_config as read_config
    from stario.fusion.evaluation.compare import demonstration as demonstration
    from stario.fusion.filter.ekf import StateCloningEkf as StateCloningEkf
    from stario.fusion.filter.initial import PriorPose as PriorPose
    from stario.fusion.fix_file import read_fixes as read_fixes
    from stario.fusion.fixes import position_fix as position_fix
    from stario.fusion.fixes import velocity_fix as velocity_fix
    from stario.fusion.fixes import yaw_fix as yaw_fix
    from stario.fusion.navigator import Navigator as Navigator
    from stario.fusion.state import Health as Health
    from stario.fusion.state import NavState as NavState
    from stario.fusion.state import Track as Track

_MODULES = {
    "FilterConfig": "config",
    "Health": "state",
    "NavState": "state",
    "Navigator": "navigator",
    "NavigatorConfig": "config",
    "PriorPose": "filter.initial",
    "StateCloningEkf": "filter.ekf",
    "Track": "state",
    "demonstration": "evaluation.compare",
    "yaw_fix": "fixes",
    "position_fix": "fixes",
    "read_config": "config",
    "read_fixes": "fix_file",
    "velocity_fix": "fixes",
}

__all__ = [
    "FilterConfig",
    "Health",
    "NavState",
    "Navigator",
    "NavigatorConfig",
    "PriorPose",
    "StateCloningEkf",
    "Track",
    "demonstration",
    "position_fix",
    "read_config",
    "read_fixes",
    "velocity_fix",
    "yaw_fix",
]
__getattr__ = lazy_attributes("stario.fusion", _MODULES)
