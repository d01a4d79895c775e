import os
from functools import lru_cache

# Two workers share the cores, and small matrices need one thread. Set before NumPy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# The same examples in every run; `--hypothesis-profile default` looks for others.
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")


@pytest.fixture(scope="session", autouse=True)
def _sessions_once():
    """Open ONNX Runtime's session once for the same weights, which takes a fifth of a second.

    An engine shares nothing else: the network that one is trained from is its own.
    """
    from stario.network import model
    from stario.network.runtime.engines import OnnxEngine

    opened = lru_cache(maxsize=4)(model.weights_engine)

    def engine(architecture, content):
        first = opened(architecture, content)
        if first is None:
            return None
        own = OnnxEngine.__new__(OnnxEngine)
        vars(own).update((k, v) for k, v in vars(first).items() if k != "training_form")
        return own

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "weights_engine", engine)
        yield
