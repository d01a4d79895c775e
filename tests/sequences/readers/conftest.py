import pytest
from published_formats import WRITERS, walk_of

from stario.sequences import WalkStyle, generate_walk, simulate_imu


@pytest.fixture(scope="module")
def walk():
    return simulate_imu(generate_walk(4, 10.0, style=WalkStyle()), rate=200.0)


@pytest.fixture(scope="session")
def walks():
    made = {}

    def walk(rate):
        if rate not in made:
            made[rate] = walk_of(rate, 2400.0 / rate)
        return made[rate]

    return walk


@pytest.fixture(scope="module", params=list(WRITERS))
def written(request, tmp_path_factory, walks):
    """A recording in each format and the format name to be recognised; not to be modified."""
    name, rate, write = WRITERS[request.param]
    return name, write(tmp_path_factory.mktemp("set") / "seq_1", walks(rate))
