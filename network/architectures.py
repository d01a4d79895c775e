"""Registry of networks by their names in the paper's table."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from stario.sequences.arrays import check_choice

if TYPE_CHECKING:
    from torch import nn


@dataclass(frozen=True)
class Architecture:
    """A network's class and its figures in the paper's table.

    Attributes:
        kind: name of the class, which takes the number of outputs.
        parameters: parameters in the paper's table [millions].
        flops: FLOPs for one window in the paper's table [millions].
        heads: 2 if displacement and log sigma have a head each, both counted by the table.
        options: arguments of the class besides the number of outputs.
    """

    kind: str
    parameters: float
    flops: float
    heads: int = 1
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def table_outputs(self) -> int:
        """Number of outputs counted in the paper's table: horizontal mean velocity, per head."""
        return 2 * self.heads


ARCHITECTURES = {
    "R-ResNet": Architecture("RoninResNet", 4.635, 38.252),
    "R-LSTM": Architecture("RoninLstm", 13.589, 57.473),
    "RNIN": Architecture("Rnin", 5.259, 72.032, heads=2),
    "I-IMUNet": Architecture("ImuNet", 3.659, 18.838),
    "I-MobileNet": Architecture("MobileNet", 3.179, 34.559),
    "I-MnasNet": Architecture("MnasNet", 2.979, 25.256),
    "I-EfficientNetB0": Architecture("EfficientNetB0", 3.232, 28.831),
    "DeepILS": Architecture("DeepIls", 2.291, 15.287),
    "TLIO": Architecture("Tlio", 5.424, 39.436, heads=2),
    "StarIO without MSGCU": Architecture("StarIO", 2.252, 21.555, options={"gated_unit": False}),
    "StarIO": Architecture("StarIO", 2.762, 25.122),
}
"""Networks by name, in the order of the paper's table."""


def architecture(name: str) -> Architecture:
    """Look a network up by name.

    Raises:
        InputError: no network has that name.
    """
    check_choice("architecture", name, ARCHITECTURES)
    return ARCHITECTURES[name]


def build_network(name: str, outputs: int = 6) -> nn.Module:
    """Build an untrained network that maps (B, 6, 200) to (B, outputs).

    Args:
        name: name of the architecture.
        outputs: 6 for displacement and log standard deviation; an architecture's `table_outputs`
            for the paper's table.

    Raises:
        InputError: no network has that name.
    """
    entry = architecture(name)
    from stario.network.baselines import networks
    from stario.network.stario import StarIO

    kind = StarIO if entry.kind == "StarIO" else getattr(networks, entry.kind)
    network: nn.Module = kind(outputs, **entry.options)
    return network
