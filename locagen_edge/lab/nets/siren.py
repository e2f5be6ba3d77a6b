"""SIREN: Sitzmann, Martel, Bergman, Lindell & Wetzstein, "Implicit neural representations with periodic
activation functions", NeurIPS 2020, with the initialisation of its section 3.2."""

from __future__ import annotations

import math
from itertools import pairwise

import torch

from locagen_edge.lab.settings import SirenSettings


class Sine(torch.nn.Module):
    """x to sin(omega (W x + b))."""

    def __init__(self, inputs: int, outputs: int, omega: float, bound: float) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(inputs, outputs)
        self.omega = omega
        torch.nn.init.uniform_(self.linear.weight, -bound, bound)
        torch.nn.init.uniform_(self.linear.bias, -bound, bound)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.sin(self.omega * self.linear(x))


def siren(inputs: int, s: SirenSettings) -> torch.nn.Module:
    """`inputs` features to cosine and sine.

    The first layer's weights are uniform within 1 / inputs, the others' within sqrt(6 / width) / omega, so
    that every hidden sine's argument starts with the standard deviation 1 whatever the depth; biases within
    the same bounds; the last layer is linear.
    """
    bound = math.sqrt(6.0 / s.width) / s.omega_hidden
    first = Sine(inputs, s.width, s.omega, 1.0 / inputs)
    hidden = [Sine(i, o, s.omega_hidden, bound) for i, o in pairwise([s.width] * s.layers)]
    last = torch.nn.Linear(s.width, 2)
    torch.nn.init.uniform_(last.weight, -bound, bound)
    return torch.nn.Sequential(first, *hidden, last)
