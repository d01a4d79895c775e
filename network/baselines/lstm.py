"""R-LSTM: RoNIN's recurrent network, as the StarIO paper's table counts it.

Herath, Yan, Furukawa: RoNIN: Robust Neural Inertial Navigation in the Wild, ICRA 2020. The table's
count is that of a head which sees every time step at once, larger than RoNIN's own.
"""

from __future__ import annotations

from torch import Tensor, nn

from stario.network.baselines.parts import FCOut
from stario.sequences.windows import WINDOW_SAMPLES


class RoninLstm(nn.Module):
    """(B, 6, 200) to (B, outputs); its state begins at zero in every window."""

    def __init__(self, outputs: int = 6) -> None:
        super().__init__()
        self.lstm = nn.LSTM(6, 100, num_layers=3, batch_first=True)
        self.head = FCOut(100, 128, WINDOW_SAMPLES, 512, outputs)

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        features, _ = self.lstm(windows.transpose(1, 2))
        output: Tensor = self.head(features.transpose(1, 2))
        return output
