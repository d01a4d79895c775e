"""The navigator of streams and recordings.

Samples are cut into IMU intervals (`imu.front_end`), the network predicts displacements from their
windows, and both drive an estimator (`filter.estimator`). A stream is processed sample by sample,
while the windows of a recording pass through the network in batches. Since the front end does not
depend on the filter, the filter's track of both is the same. A recording is known to its end: its
track is smoothed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from stario.fusion.backends import BackendName, track_recording
from stario.fusion.filter.initial import PriorPose
from stario.fusion.imu.inference import Predictor
from stario.fusion.recording import PreprocessedRecording, Progress, preprocess, silent
from stario.fusion.snapshot import check_same, pack, unpack
from stario.fusion.stream import Stream
from stario.fusion.values.checked import Vector, hectopascals, seconds, three
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Fix, FixOutcome, position_fix, velocity_fix, yaw_fix
from stario.fusion.values.health import Health
from stario.fusion.values.state import ContinuousPose, NavState, SmoothedPose, Track, copied
from stario.sequences.arrays import check_choice, check_type
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence


class Navigator:
    """Inertial navigation with a displacement network.

    Threads may share a model but not a navigator: use a lock if fixes come from another thread.
    If the model raises an error in `push`, the stream continues with the next sample.

    Args:
        model: a `DisplacementModel`, or any object with its `predict`.
        config: noise, filter, gravity; the defaults are for handheld devices.
        prior: prior on the first pose; None starts levelled by gravity, with yaw and position zero.
        backend: "ekf" or "graph" for the EKF or the factor graph, of streams and recordings; None
            has what suits each: the EKF for a stream, the graph over the whole of a recording.

    Raises:
        InputError: the back end does not exist, or an argument has the wrong type.
    """

    def __init__(
        self,
        model: Predictor,
        config: NavigatorConfig | None = None,
        prior: PriorPose | None = None,
        backend: BackendName | None = None,
    ) -> None:
        if backend is not None:
            check_choice("backend", backend, get_args(BackendName))
        if not hasattr(model, "predict") or isinstance(model, type):
            remedy = "load_model(name) returns one"
            raise InputError("model", repr(model), "a model with `predict`", remedy)
        check_type("config", config, NavigatorConfig, optional=True)
        check_type("prior", prior, PriorPose, optional=True)
        self.backend = backend
        self.model = model
        self.config = config or NavigatorConfig()
        self._stream = self._new_stream(prior)

    def push(self, time: float, gyro: Vector, accel: Vector) -> NavState | None:
        """Process one sample of a stream.

        Samples that are not finite, repeated or late are dropped and counted (`health`); gaps are
        detected. The first state comes one second after the first sample, and the next one a second
        after the end of each gap (`health.gaps`): that second levels the attitude.

        Args:
            time: [s].
            gyro: (3,) angular rate in B [rad/s].
            accel: (3,) specific force in B [m/s^2].

        Returns:
            The newest state if this sample completed an output period, else None.

        Raises:
            InputError: time is not a number, or every sample is far from the previous one (time not
                in seconds), or a thousand have the same time (time in 32 bits); gyro or accel does
                not hold three numbers; the mean force of the first second cannot be gravity in
                m/s^2 or contradicts the prior's attitude, or the rate is not about 50 Hz to 1 kHz;
                gyro cannot be in rad/s or one sensor's values never change, which shows once the
                device turns; or the clock was set back by at least five seconds (after less,
                samples are late until it has caught up). After the last six the stream starts
                again; after a clock that was set back, without prior and fixes.
        """
        return self._stream.push((seconds(time), *three("gyro", gyro), *three("accel", accel)))

    def push_magnetometer(self, time: float, field: Vector) -> None:
        """Process one magnetometer sample of a stream, before the IMU samples that follow it.

        Its bearing makes the gyroscope's vertical bias observable; disturbances are detected by
        size, dip and consistency (`filter.magnetic`). Samples that are not finite, repeated, or
        late by more than a tenth of a second are dropped and counted. The magnetometer is optional.

        Args:
            time: [s], on the IMU's clock.
            field: (3,) magnetic flux density in B [uT].

        Raises:
            InputError: time is not a number, or field does not hold three numbers.
        """
        self._stream.front_end.push_field(seconds(time), np.array(three("field", field)))

    def push_pressure(self, time: float, hPa: float) -> None:
        """Process one pressure of a stream's barometer, before the IMU samples that follow it.

        It tells changes of the height, on stairs and in lifts as well (`filter.height`), each half
        second by the average of the pressures in it. Those that come later than their average do
        not count; those more than a tenth of a second before its end are dropped and counted, as
        are those that are not finite or repeat an earlier time. The barometer is optional.

        Args:
            time: [s], on the IMU's clock.
            hPa: pressure of the air [hPa], about 1013 at sea level.

        Raises:
            InputError: time or pressure is not a number, or the pressure is one in another unit.
        """
        self._stream.front_end.push_pressure(seconds(time), hectopascals(hPa))

    def update_position(self, time: float, p_W: ArrayLike, covariance: ArrayLike) -> FixOutcome:
        """Apply a position fix to the stream.

        It is applied at its own time, which may lie up to one window (1 s) before the newest state
        or in the future. Older fixes, values that are not finite and invalid covariances are
        refused and counted in `health`. A track that started without a pose is moved to its first
        position fix and turned by the first later one that is far enough away (`filter.map_frame`).
        Between the two its yaw in the map is unknown, and so are positions further on: covariances
        say so. States with different `map_frame` must not be compared.

        Args:
            time: [s], on the samples' clock.
            p_W: (3,) [m].
            covariance: (3, 3) [m^2]; use a large variance, such as 1e6, for an unknown height.

        Returns:
            What became of it: "applied", "inflated" (an outlier, with a larger covariance),
            "waiting" until its time or the first state, or "refused", with the reason in `health`.

        Raises:
            InputError: a value has another shape, or the position is one in degrees.
        """
        return self._stream.take(position_fix(time, p_W, covariance))

    def update_velocity(self, time: float, v_W: ArrayLike, covariance: ArrayLike) -> FixOutcome:
        """Apply a velocity fix (3,) [m/s] in W with covariance (3, 3); see `update_position`.

        Rotate velocities measured along the body's axes, as by wheels, by the attitude first.
        """
        return self._stream.take(velocity_fix(time, v_W, covariance))

    def update_yaw(self, time: float, yaw: float, sigma: float) -> FixOutcome:
        """Apply a fix of the body's yaw [rad]; see `update_position`.

        Yaw counts counter-clockwise from the map's x axis, unlike a compass heading; at any tilt it
        is that of the twist about the vertical (`lie.yaw_twist`).
        """
        return self._stream.take(yaw_fix(time, yaw, sigma))

    @property
    def prior(self) -> PriorPose | None:
        """Prior on the first pose."""
        return self._stream.prior

    @property
    def state(self) -> NavState | None:
        """Newest state of the stream; None during the first second."""
        return self._stream.nav_state()

    @property
    def continuous(self) -> ContinuousPose | None:
        """Newest pose, without steps at updates; None during the first second."""
        pose = self._stream.continuous
        return None if pose is None else copied(pose)

    @property
    def smoothed(self) -> SmoothedPose | None:
        """Newest pose of the stream, delayed by one window (1 s) and using all measurements since.

        It changes with each network update; None before the first, and for the graph.
        """
        stream = self._stream  # the filter alone has poses one window late
        return stream.state.smoothed if stream.state and stream.graph is None else None

    @property
    def health(self) -> Health:
        """Health report of the stream so far."""
        return self._stream.health()

    def snapshot(self) -> bytes:
        """Return the current stream as bytes, to be continued by `restore` in any process.

        The format is documented in `stario.fusion.snapshot`; nothing is pickled. The bytes identify
        the configuration and the weights but do not contain the weights.
        """
        return pack(self._identity() | self._stream.parts())

    def restore(self, data: bytes) -> None:
        """Continue the stream of a `snapshot`; the states are those without the interruption.

        The navigator must have the same back end, configuration and weights; the snapshot's stream
        and prior replace its own.

        Raises:
            InputError: the bytes are not a complete snapshot of this version, or belong to another
                back end, configuration or model. The navigator is then unchanged.
        """
        parts = unpack(data)
        for name, value in self._identity().items():
            check_same(name, parts[name], value)
        stream = self._new_stream(None)
        stream.continue_from(parts)
        self._stream = stream

    def run(
        self, sequence: ImuSequence, progress: Progress = silent, fixes: Iterable[Fix] = ()
    ) -> Track:
        """Estimate the smoothed track of a recording; its ground truth is not used.

        Each state uses all measurements, also the later ones. `Track.filtered` is what a stream
        gives: the filter's states, and those of the first second and of the second after each gap
        as well; with `backend="ekf"` it is the track. The stream of `push` is not affected.

        Args:
            sequence: the recording.
            progress: called from time to time with the fraction of the work done.
            fixes: position, yaw or velocity fixes, in any order; invalid ones and those outside the
                recording are refused and counted. The whole track is given in its final map frame.

        Raises:
            InputError: the recording is shorter than 1.5 s, its units or rate are wrong, or gravity
                contradicts the prior's attitude.
        """
        return self.track(self.observe(sequence, progress), progress, fixes)

    def observe(self, sequence: ImuSequence, progress: Progress = silent) -> PreprocessedRecording:
        """Preprocess a recording and predict the displacements of its windows.

        Raises:
            InputError: as for `run`.
        """
        return preprocess(sequence, self.model, self.config, progress)

    def track(
        self,
        preprocessed: PreprocessedRecording,
        progress: Progress = silent,
        fixes: Iterable[Fix] = (),
    ) -> Track:
        """Estimate the track of a preprocessed recording; fixes as for `run`.

        Raises:
            InputError: it was preprocessed for another update rate, or gravity contradicts the
                prior's attitude.
        """
        backend = self.backend or "graph"
        return track_recording(backend, preprocessed, self.config, self.prior, fixes, progress)

    def _identity(self) -> dict[str, Any]:
        """Return what must be the same where a snapshot is restored."""
        checksum = str(getattr(getattr(self.model, "card", None), "sha256", ""))
        backend = self.backend or "ekf"
        return {"backend": backend, "config": asdict(self.config), "model": checksum}

    def _new_stream(self, prior: PriorPose | None) -> Stream:
        return Stream(self.model, self.config, prior, self.backend or "ekf")
