"""Sensor fusion: preintegration, EKF and factor graph, navigator, evaluation, command line."""

from typing import TYPE_CHECKING

from stario.sequences.lazy import lazy_attributes

if TYPE_CHECKING:
    from stario.fusion.config import FilterConfig as FilterConfig
    from stario.fusion.config import GraphConfig as GraphConfig
    from stario.fusion.config import NavigatorConfig as NavigatorConfig
    from stario.fusion.config import read_config as read_config
    from stario.fusion.evaluation.compare import Comparison as Comparison
    from stario.fusion.evaluation.compare import compare as compare
    from stario.fusion.evaluation.compare import demonstration as demonstration
    from stario.fusion.evaluation.many import compare_recordings as compare_recordings
    from stario.fusion.evaluation.summary import Scores as Scores
    from stario.fusion.evaluation.summary import scores_of as scores_of
    from stario.fusion.evaluation.summary import summary_table as summary_table
    from stario.fusion.evaluation.tracks import inertial_track as inertial_track
    from stario.fusion.evaluation.tracks import network_track as network_track
    from stario.fusion.filter.ekf import StateCloningEkf as StateCloningEkf
    from stario.fusion.filter.initial import PriorPose as PriorPose
    from stario.fusion.fix_file import read_fixes as read_fixes
    from stario.fusion.fixes import Fix as Fix
    from stario.fusion.fixes import position_fix as position_fix
    from stario.fusion.fixes import velocity_fix as velocity_fix
    from stario.fusion.fixes import yaw_fix as yaw_fix
    from stario.fusion.health import Health as Health
    from stario.fusion.imu.stateful import Predictor as Predictor
    from stario.fusion.live.run import LiveServer as LiveServer
    from stario.fusion.navigator import Navigator as Navigator
    from stario.fusion.recording import PreprocessedRecording as PreprocessedRecording
    from stario.fusion.state import ContinuousPose as ContinuousPose
    from stario.fusion.state import Innovations as Innovations
    from stario.fusion.state import NavState as NavState
    from stario.fusion.state import SmoothedPose as SmoothedPose
    from stario.fusion.state import Track as Track

_MODULES = {
    "Comparison": "evaluation.compare",
    "ContinuousPose": "state",
    "FilterConfig": "config",
    "Fix": "fixes",
    "GraphConfig": "config",
    "Health": "health",
    "Innovations": "state",
    "LiveServer": "live.run",
    "NavState": "state",
    "Navigator": "navigator",
    "NavigatorConfig": "config",
    "Predictor": "imu.stateful",
    "PreprocessedRecording": "recording",
    "PriorPose": "filter.initial",
    "Scores": "evaluation.summary",
    "SmoothedPose": "state",
    "StateCloningEkf": "filter.ekf",
    "Track": "state",
    "compare": "evaluation.compare",
    "compare_recordings": "evaluation.many",
    "demonstration": "evaluation.compare",
    "inertial_track": "evaluation.tracks",
    "network_track": "evaluation.tracks",
    "position_fix": "fixes",
    "read_config": "config",
    "read_fixes": "fix_file",
    "scores_of": "evaluation.summary",
    "summary_table": "evaluation.summary",
    "velocity_fix": "fixes",
    "yaw_fix": "fixes",
}

__all__ = [*_MODULES]
__getattr__ = lazy_attributes("stario.fusion", _MODULES)
