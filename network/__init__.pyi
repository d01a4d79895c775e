"""Public names of `stario.network`, which are imported on first use."""

from stario.network.card import Calibration as Calibration
from stario.network.card import Card as Card
from stario.network.model import DisplacementModel as DisplacementModel
from stario.network.model import load_model as load_model
from stario.network.training.augment import Augmentation as Augmentation
from stario.network.training.config import TrainingConfig as TrainingConfig
from stario.network.training.data import TrainingData as TrainingData
from stario.network.training.history import EpochReport as EpochReport
from stario.network.training.train import train as train
