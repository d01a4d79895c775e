from stario.sequences.windows import WINDOW_SAMPLES, cut_windows, window_starts


def windows_of(stream, stride):
    """Windows (M, 6, 200) of a stream and their displacements (M, 3), both in W."""
    begin = window_starts(stream, stride)
    moved_W = stream.position_W[begin + WINDOW_SAMPLES] - stream.position_W[begin]
    return cut_windows(stream.imu_W, begin), moved_W
