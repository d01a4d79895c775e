"""Neural networks: architectures, training and inference."""

from typing import TYPE_CHECKING

from stario.sequences.lazy import lazy_imports

if TYPE_CHECKING:
    from stario.network.card import Calibration as Calibration
    from stario.network.card import Card as Card
    from stario.network.model import DisplacementModel as DisplacementModel
    from stario.network.model import load_model as load_model
    from stario.network.training.augment import Augmentation as Augmentation
    from stario.network.training.config import TrainingConfig as TrainingConfig
    from stario.network.training.train import train as train

__all__, __getattr__ = lazy_imports(__name__)
