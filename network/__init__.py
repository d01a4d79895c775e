"""Networks: displacements with covariance from one-second windows of IMU data.

Use: `load_model`, `DisplacementModel`.

Train: `train`, `TrainingConfig`, `TrainingData`, `Augmentation`, `EpochReport`.

What weights are: `Card`, `Calibration`.
"""

from stario.sequences.lazy import public_names

__all__, __getattr__, __dir__ = public_names("stario.network")
