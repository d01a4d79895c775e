"""The cache key of streams covers all the code that produces them."""

from stario.sequences.datasets.stream_cache import code_files


def test_readers_levelling_windows_and_simulation_are_part_of_the_key() -> None:
    names = {"/".join(file.parts[-2:]) for file in code_files()}
    assert {
        "sequences/windows.py",
        "readers/generic_csv.py",
        "attitude/levelling.py",
        "simulation/imu.py",
        "datasets/stream_cache.py",
    } <= names
