from collections.abc import Callable

import pytest
from published_formats import WRITERS, Written, walk_of

from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk


@pytest.fixture(scope="module")
def walk() -> ImuSequence:
    return simulate_imu(generate_walk(4, 10.0, style=WalkStyle()), rate=200.0)


@pytest.fixture(scope="session")
def walks() -> Callable[[float], ImuSequence]:
    made: dict[float, ImuSequence] = {}

    def walk(rate: float) -> ImuSequence:
        if rate not in made:
            made[rate] = walk_of(rate, 4000.0 / rate)
        return made[rate]

    return walk


@pytest.fixture(scope="module", params=list(WRITERS))
def written(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    walks: Callable[[float], ImuSequence],
) -> tuple[str, Written]:
    """A recording in each format and the format name to be recognised; not to be modified."""
    name, rate, write = WRITERS[request.param]
    return name, write(tmp_path_factory.mktemp("set") / "seq_1", walks(rate))
