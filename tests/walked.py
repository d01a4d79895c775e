from stario.sequences import PHONE_IMU, WalkStyle, generate_walk, simulate_imu


def walked(seed, seconds, errors=PHONE_IMU, imu_seed=0, rate=100.0, name="walk", **style):
    """A simulated recording of a walk in some style: how the device is carried, how fast."""
    track = generate_walk(seed, seconds, style=WalkStyle(**style))
    return simulate_imu(track, rate, errors, imu_seed, name=name)
