"""Recordings: read, inspect, simulate, compare, write.

Read and write: `read_recording`, `find_recordings`, `write_csv`, `read_tum`, `write_tum`.

A recording: `ImuSequence`, `Trajectory`, `PositionTrack`, `Magnetometer`, `Barometer`,
`Satellites`, `DeviceAttitude`, `STANDARD_GRAVITY`.

Inspect: `inspect_recording`, `Inspection`, `Finding`, `verdict`, `truth_findings`, `check_units`.

Units, axes, maps: `with_units`, `with_conventions`, `yaw_of`, `about_z`, `Georeference`.

Compare a track with the truth: `align`, `Alignment`, `evaluate_track`, `TrackMetrics`,
`position_nees`, `PositionNees`.

Simulate: `generate_walk`, `WalkStyle`, `simulate_imu`, `ImuErrors`, `PERFECT_IMU`, `GOOD_IMU`,
`PHONE_IMU`, `MagneticField`, `INDOOR_FIELD`, `ImuNoise`, `measured_stride`, `on_one_side`,
`StrideCycle`.

For training: `world_streams`, `WorldStream`, `leg_streams`, `LegStream`.

Errors: `StarioError`, `InputError`, `ReadError`, `ConfigError`, `WeightsError`, `Skipped`.
"""

from stario.sequences.lazy import public_names

__all__, __getattr__, __dir__ = public_names("stario.sequences")
