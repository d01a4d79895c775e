import pickle
from pathlib import Path

import pytest

from stario.sequences.errors import ConfigError, InputError, ReadError, StarioError, WeightsError


@pytest.mark.parametrize(
    "error",
    [
        StarioError("text"),
        InputError("field", "found", "expected", "fix"),
        ConfigError("field", "found", "expected"),
        ReadError(Path("a.csv"), "field", "found", "expected"),
        WeightsError("a.safetensors", "field", "found", "expected", "fix"),
    ],
)
@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_errors_survive_pickling_unchanged(error: StarioError, protocol: int) -> None:
    again = pickle.loads(pickle.dumps(error, protocol))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
