"""Recordings: sequences, readers, simulation, windows, metrics and figures."""

from typing import TYPE_CHECKING

from stario.sequences.lazy import lazy_attributes

if TYPE_CHECKING:
    from stario.sequences.accuracy.metrics import align as align
    from stario.sequences.accuracy.metrics import evaluate_track as evaluate_track
    from stario.sequences.accuracy.nees import position_nees as position_nees
    from stario.sequences.attitude.rotations import about_z as about_z
    from stario.sequences.attitude.rotations import yaw_of as yaw_of
    from stario.sequences.conventions import with_conventions as with_conventions
    from stario.sequences.datasets.batch import Skipped as Skipped
    from stario.sequences.errors import ConfigError as ConfigError
    from stario.sequences.errors import InputError as InputError
    from stario.sequences.errors import ReadError as ReadError
    from stario.sequences.errors import StarioError as StarioError
    from stario.sequences.errors import WeightsError as WeightsError
    from stario.sequences.inspection.checks import check_units as check_units
    from stario.sequences.inspection.report import inspect_recording as inspect_recording
    from stario.sequences.legs import LegStream as LegStream
    from stario.sequences.legs import leg_streams as leg_streams
    from stario.sequences.noise import ImuNoise as ImuNoise
    from stario.sequences.readers import find_recordings as find_recordings
    from stario.sequences.readers import read_recording as read_recording
    from stario.sequences.readers.csv_writer import write_csv as write_csv
    from stario.sequences.readers.tum import read_tum as read_tum
    from stario.sequences.readers.tum import write_tum as write_tum
    from stario.sequences.sequence import STANDARD_GRAVITY as STANDARD_GRAVITY
    from stario.sequences.sequence import DeviceAttitude as DeviceAttitude
    from stario.sequences.sequence import ImuSequence as ImuSequence
    from stario.sequences.sequence import Magnetometer as Magnetometer
    from stario.sequences.sequence import PositionTrack as PositionTrack
    from stario.sequences.sequence import Trajectory as Trajectory
    from stario.sequences.simulation.imu import GOOD_IMU as GOOD_IMU
    from stario.sequences.simulation.imu import PERFECT_IMU as PERFECT_IMU
    from stario.sequences.simulation.imu import PHONE_IMU as PHONE_IMU
    from stario.sequences.simulation.imu import ImuErrors as ImuErrors
    from stario.sequences.simulation.imu import simulate_imu as simulate_imu
    from stario.sequences.simulation.magnetometer import INDOOR_FIELD as INDOOR_FIELD
    from stario.sequences.simulation.magnetometer import MagneticField as MagneticField
    from stario.sequences.simulation.walks import WalkStyle as WalkStyle
    from stario.sequences.simulation.walks import generate_walk as generate_walk
    from stario.sequences.truth.problems import truth_problems as truth_problems
    from stario.sequences.units import with_units as with_units
    from stario.sequences.windows import world_streams as world_streams

_NAMES = {
    "accuracy.metrics": "align evaluate_track",
    "accuracy.nees": "position_nees",
    "attitude.rotations": "about_z yaw_of",
    "conventions": "with_conventions",
    "datasets.batch": "Skipped",
    "errors": "ConfigError InputError ReadError StarioError WeightsError",
    "inspection.checks": "check_units",
    "inspection.report": "inspect_recording",
    "legs": "LegStream leg_streams",
    "noise": "ImuNoise",
    "readers": "find_recordings read_recording",
    "readers.csv_writer": "write_csv",
    "readers.tum": "read_tum write_tum",
    "sequence": "DeviceAttitude ImuSequence Magnetometer PositionTrack STANDARD_GRAVITY Trajectory",
    "simulation.imu": "GOOD_IMU ImuErrors PERFECT_IMU PHONE_IMU simulate_imu",
    "simulation.magnetometer": "INDOOR_FIELD MagneticField",
    "simulation.walks": "WalkStyle generate_walk",
    "truth.problems": "truth_problems",
    "units": "with_units",
    "windows": "world_streams",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_MODULES)
__getattr__ = lazy_attributes("stario.sequences", _MODULES)
