"""What we conclude: preintegration, filter, navigator, tracks, command."""

from typing import TYPE_CHECKING

from stario.sequences.lazy import lazy_attributes

if TYPE_CHECKING:
    from stario.fusion.compare import demonstration as demonstration
    from stario.fusion.config import FilterConfig as FilterConfig
    from stario.fusion.config import NavigatorConfig as NavigatorConfig
    from stario.fusion.config import read_config as read_config
    from stario.fusion.ekf import StateCloningEkf as StateCloningEkf
    from stario.fusion.navigator import Navigator as Navigator
    from stario.fusion.recipe import PriorPose as PriorPose
    from stario.fusion.state import Health as Health
    from stario.fusion.state import NavState as NavState
    from stario.fusion.state import Track as Track

_MODULES = {
    "FilterConfig": "config",
    "Health": "state",
    "NavState": "state",
    "Navigator": "navigator",
    "NavigatorConfig": "config",
    "PriorPose": "recipe",
    "StateCloningEkf": "ekf",
    "Track": "state",
    "demonstration": "compare",
    "read_config": "config",
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
    "read_config",
]
__getattr__ = lazy_attributes("stario.fusion", _MODULES)
