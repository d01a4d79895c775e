"""What is learned: the networks, their training and their use."""

from typing import TYPE_CHECKING

from stario.sequences.lazy import lazy_attributes

if TYPE_CHECKING:
    from stario.network.card import Calibration as Calibration
    from stario.network.card import Card as Card
    from stario.network.model import DisplacementModel as DisplacementModel
    from stario.network.model import load_model as load_model
    from stario.network.training.augment import Augmentation as Augmentation
    from stario.network.training.config import TrainingConfig as TrainingConfig

_MODULES = {
    "Augmentation": "training.augment",
    "Calibration": "card",
    "Card": "card",
    "DisplacementModel": "model",
    "TrainingConfig": "training.config",
    "load_model": "model",
}

__all__ = [
    "Augmentation",
    "Calibration",
    "Card",
    "DisplacementModel",
    "TrainingConfig",
    "load_model",
]
__getattr__ = lazy_attributes("stario.network", _MODULES)
