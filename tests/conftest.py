"""What all tests share. onnxruntime's telemetry is off before anything can import it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from alsa.card import Missing, VirtualCard, build
from hypothesis import HealthCheck
from hypothesis import settings as hypothesis_settings

os.environ["ORT_DISABLE_TELEMETRY"] = "1"

# Time is the machine's affair, not a law; the same examples every time: a red test stays red.
hypothesis_settings.register_profile(
    "laws", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
# New examples every night, and many more of them.
hypothesis_settings.register_profile(
    "nightly", deadline=None, max_examples=2000, suppress_health_check=[HealthCheck.too_slow]
)
hypothesis_settings.load_profile("nightly" if os.environ.get("LOCAGEN_NIGHTLY") else "laws")

ROOT = Path(__file__).resolve().parent.parent

RECORDINGS = Path(os.environ.get("LOCAGEN_RECORDINGS", ROOT.parent / "shared" / "data" / "audio"))
"""Recorded speech and rotor noise, not part of the project: tests that need it skip where it is absent."""


@pytest.fixture(scope="session")
def recordings() -> Path:
    if not (RECORDINGS / "MANIFEST.csv").is_file():
        pytest.skip(f"no recordings at {RECORDINGS}: set LOCAGEN_RECORDINGS to a folder with MANIFEST.csv")
    return RECORDINGS


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The virtual sound card, compiled."""
    try:
        return build(tmp_path_factory.mktemp("plugin"))
    except Missing as missing:
        pytest.skip(str(missing))


@pytest.fixture
def card(library: Path, tmp_path: Path) -> VirtualCard:
    return VirtualCard(library, tmp_path)


SMALL = """
[mixes]
clip_s = 0.6
before_s = 0.5
pool = 8

[wave]
width = 8
batch = 4
steps = 6
check = 3

[mask]
width = 8
blocks = 1
batch = 4
steps = 6
check = 3
"""
"""Settings of denoisers that are trained in a second."""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("denoise") / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture(scope="module")
def few_sounds() -> Iterator[None]:
    """Synthesised classes of ten utterances, without espeak-ng: other machines have none."""
    from locagen_edge.lab.denoise import sounds

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sounds, "SYNTHESISED", 10)
        patch.setattr(sounds, "ROTORS", 4)
        patch.setattr(sounds.shutil, "which", lambda _: None)
        yield
