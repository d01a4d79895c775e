"""Sensor fusion: tracks with uncertainty, from recordings and streams.

Navigate: `Navigator`, `BackendName`, `NavState`, `Track`, `SmoothedPose`, `ContinuousPose`,
`Health`, `Innovations`.

Configure: `NavigatorConfig`, `FilterConfig`, `GraphConfig`, `PlaceConfig`, `read_config`,
`PriorPose`.

Fixes from outside: `Fix`, `FixOutcome`, `position_fix`, `velocity_fix`, `yaw_fix`, `read_fixes`.

Compare tracks: `compare`, `Comparison`, `compare_recordings`, `summary_table`, `network_track`,
`inertial_track`, `demonstration`.

Parts on their own: `UpdateResult`, `preintegrate`, `Segment`, `Predictor`,
`PreprocessedRecording`, `WindowDisplacement`.

Live: `LiveServer`, with the extra live.
"""

from stario.sequences.lazy import public_names

__all__, __getattr__, __dir__ = public_names("stario.fusion")
