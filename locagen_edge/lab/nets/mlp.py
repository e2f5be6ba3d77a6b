"""Multilayer perceptron."""

from __future__ import annotations

from itertools import pairwise

import torch

from locagen_edge.lab.settings import MlpSettings


def mlp(inputs: int, s: MlpSettings) -> torch.nn.Module:
    """`inputs` features to cosine and sine, tanh between: the answer is smooth, and a rectifier's is not."""
    sizes = [inputs, *[s.width] * s.layers]
    hidden = [part for i, o in pairwise(sizes) for part in (torch.nn.Linear(i, o), torch.nn.Tanh())]
    return torch.nn.Sequential(*hidden, torch.nn.Linear(s.width, 2))
