from stario.sequences.windows import window_starts, windows_at


def windows_of(stream, stride):
    return windows_at(stream, window_starts(stream, stride))
