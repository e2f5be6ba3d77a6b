"""What denoisers are compared with: Wiener filters with the same noise reference, and well-known packages.

Every method takes the sound (n,) at 10 kHz, whose first `before` samples are noise alone, and gives (n,)
without delay. A package that is not installed is named in the report with what would install it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np
import soxr

from locagen_edge.stages.denoise import RATE_HZ, STEP, WINDOW, decision_directed, window
from locagen_edge.types import F32, Array

Method = Callable[[F32, int], F32]


def spectra_of(sound: F32) -> Array:
    """(n,) to (spectra, bins), the grid of the mask."""
    padded = np.pad(sound, (STEP, WINDOW))
    return np.fft.rfft(np.lib.stride_tricks.sliding_window_view(padded, WINDOW)[::STEP] * window())


def sound_of(spectra: Array, n: int) -> F32:
    """The way back from `spectra_of`."""
    pieces = np.fft.irfft(spectra) * window()
    out = np.zeros(len(pieces) * STEP + STEP)
    for k, piece in enumerate(pieces):
        out[k * STEP : k * STEP + WINDOW] += piece
    return out[STEP : STEP + n].astype(np.float32)


def wiener(sound: F32, before: int) -> F32:
    """Wiener's gain with the spectrum of the noise before, decision-directed."""
    spectra = spectra_of(sound)
    noise = (np.abs(spectra[1 : before // STEP]) ** 2).mean(axis=0) + 1e-12
    gains, _ = decision_directed(np.abs(spectra) ** 2 / noise, np.zeros(len(noise)))
    return sound_of(spectra * gains, len(sound))


def wiener_plain(sound: F32, before: int) -> F32:
    """Wiener's gain 1 - N / P of each moment, P smoothed over three spectra and bins."""
    spectra = spectra_of(sound)
    power = np.abs(spectra) ** 2
    noise = power[1 : before // STEP].mean(axis=0) + 1e-12
    ratio = power / noise
    smooth = ratio.copy()
    smooth[:, 1:-1] = 0.25 * ratio[:, :-2] + 0.5 * ratio[:, 1:-1] + 0.25 * ratio[:, 2:]
    smooth[1:] = 0.5 * smooth[1:] + 0.5 * smooth[:-1]
    return sound_of(spectra * np.maximum(1.0 - 1.0 / np.maximum(smooth, 1e-9), 0.05), len(sound))


def _noisereduce() -> Method:
    noisereduce = importlib.import_module("noisereduce")

    def run(sound: F32, before: int) -> F32:
        cleaned = noisereduce.reduce_noise(
            y=sound, sr=RATE_HZ, stationary=True, y_noise=sound[:before], n_fft=WINDOW, hop_length=STEP
        )
        return np.asarray(cleaned, dtype=np.float32)

    return run


def _speexdsp() -> Method:
    speexdsp = importlib.import_module("speexdsp_ns")
    block = 160

    def frames(whole: Array) -> Array:
        suppressor = speexdsp.NoiseSuppression.create(block, 16_000)
        pieces = [suppressor.process(row.tobytes()) for row in whole]
        return np.frombuffer(b"".join(pieces), np.int16)

    return _at(16_000, block, frames)


def _webrtc() -> Method:
    webrtc = importlib.import_module("webrtc_noise_gain")
    block = 160

    def frames(whole: Array) -> Array:
        processor = webrtc.AudioProcessor(0, 2)  # no gain control; noise suppression level 2
        pieces = [processor.Process10ms(row.tobytes()).audio for row in whole]
        return np.frombuffer(b"".join(pieces), np.int16)

    return _at(16_000, block, frames)


def _rnnoise() -> Method:
    rnnoise = importlib.import_module("pyrnnoise.rnnoise")
    block = 480

    def frames(whole: Array) -> Array:
        state = rnnoise.create()
        pieces = [rnnoise.process_mono_frame(state, row)[0] for row in whole]
        rnnoise.destroy(state)
        return np.concatenate(pieces)

    return _at(48_000, block, frames)


def _at(rate_hz: int, block: int, frames: Callable[[Array], Array]) -> Method:
    """A method on 16-bit blocks (k, block) at its own rate; its delay, up to 60 ms, is taken out."""

    def run(sound: F32, _: int) -> F32:
        scale = 0.25 / max(
            float(np.abs(sound).max()), 1e-9
        )  # loud enough for 16 bits and for voice detectors
        there = soxr.resample(sound * scale, RATE_HZ, rate_hz)
        there = np.pad(there, (0, -len(there) % block + 4 * block))
        whole = np.ascontiguousarray((there * 32767.0).astype(np.int16).reshape(-1, block))
        back = soxr.resample(frames(whole).astype(np.float32) / 32767.0, rate_hz, RATE_HZ) / scale
        return _aligned(back, sound)

    return run


def _aligned(late: F32, sound: F32) -> F32:
    """`late` without its delay, the one that fits `sound` best; a method is not judged by being late."""
    n = len(sound)
    size = 1 << (2 * n).bit_length()
    agreement = np.fft.irfft(np.fft.rfft(late, size) * np.conj(np.fft.rfft(sound, size)))
    delay = int(np.argmax(agreement[: int(0.06 * RATE_HZ)]))
    return np.pad(late[delay : delay + n], (0, max(0, n - len(late[delay:])))).astype(np.float32)


PEERS: dict[str, tuple[Callable[[], Method], str]] = {
    "noisereduce, stationary, not causal": (_noisereduce, "noisereduce"),
    "speexdsp": (_speexdsp, "speexdsp-ns"),
    "WebRTC, level 2": (_webrtc, "webrtc-noise-gain"),
    "RNNoise": (_rnnoise, "pyrnnoise"),
}
"""Packages by name: what makes the method, and what to install."""


def peers() -> tuple[dict[str, Method], dict[str, str]]:
    """Those that are there, and of the others why not."""
    found: dict[str, Method] = {}
    missing: dict[str, str] = {}
    for name, (make, package) in PEERS.items():
        try:
            method = make()
            method(np.full(8192, 1e-3, dtype=np.float32), 4096)  # some fail only when they are used
            found[name] = method
        except Exception as error:
            missing[name] = f"pip install {package} ({type(error).__name__}: {error})"
    return found, missing
