"""Calls for help: stand-ins with the traits that matter to localisation, which is how they fill the band.

Each function makes one utterance (n,) of any level, with nothing above `top_hz`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from locagen_edge.sim.synth import band_noise, glide, turns_of, wave, wavetable
from locagen_edge.types import F64

Call = Callable[[int, float, float, np.random.Generator], F64]

# Formants F1 to F3 of vowels, men: Peterson & Barney, J. Acoust. Soc. Am. 24 (1952), table II, Hz
VOWELS = ((730, 1090, 2440), (270, 2290, 3010), (300, 870, 2240), (530, 1840, 2480), (570, 840, 2410))
FORMANT_WIDTH_HZ = 120.0


def white(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """Noise that fills the band evenly: the easiest of all."""
    return band_noise(n, rate_hz, 100.0, top_hz, rng)


def speech(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """Raised voice: four syllables a second, each a gliding pitch under one vowel, with a hiss before it.

    Between the harmonics and between the syllables there is nothing, and most power is below 1 kHz.
    """
    out = np.zeros(n)
    start = 0
    while start < n:
        length = int(rate_hz * rng.uniform(0.18, 0.32))
        if n - start < 1.5 * length:  # no crumbs
            length = n - start
        out[start : start + length] = _syllable(length, rate_hz, top_hz, rng)
        start += length
    return out


def _syllable(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    pitch = glide(rng.uniform(220.0, 380.0, 3), n)
    harmonics = pitch.mean() * np.arange(1, max(2, int(top_hz / pitch.max()) + 1))
    formants = np.array(VOWELS[rng.integers(len(VOWELS))])[:, np.newaxis]
    resonance = np.sum(1.0 / (1.0 + ((harmonics - formants) / FORMANT_WIDTH_HZ) ** 2), axis=0)
    # the glottis falls by 12 dB an octave, the lips raise by 6: -6 dB an octave in all
    voiced = wave(wavetable((resonance + 0.01) / harmonics * 100.0, rng), turns_of(pitch, rate_hz))
    hiss = band_noise(n, rate_hz, 0.5 * top_hz, top_hz, rng)
    at = np.arange(n) / n
    sound: F64 = voiced * np.sin(np.pi * at) ** 0.7 + hiss * at * np.exp(-12.0 * at)
    return sound


def scream(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """A high gliding pitch, rough: its loudness flutters at 30 to 150 Hz, which is what makes a scream
    (Arnal et al., Current Biology 25 (2015) 2051-2056), with breath noise 15 dB below.
    """
    pitch = glide(rng.uniform(850.0, 1250.0, 5), n)
    count = max(1, int(top_hz / pitch.max()))
    voiced = wave(wavetable(0.7 ** np.arange(count), rng), turns_of(pitch, rate_hz))
    flutter = glide(rng.uniform(50.0, 100.0, 4), n)
    rough = 1.0 + 0.6 * np.sin(2.0 * np.pi * turns_of(flutter, rate_hz))
    breath = 0.18 * np.sqrt(np.mean(voiced**2)) * band_noise(n, rate_hz, 300.0, top_hz, rng)
    sound: F64 = voiced * rough + breath
    return sound


def whistle(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """A referee's whistle: a tone at 3 kHz that its pea shakes in pitch and loudness 30 times a second."""
    middle = min(rng.uniform(2800.0, 3200.0), 0.7 * top_hz)
    shake = np.sin(2.0 * np.pi * 30.0 * np.arange(n) / rate_hz)
    sound: F64 = np.sin(2.0 * np.pi * turns_of(middle * (1.0 + 0.03 * shake), rate_hz))
    sound *= 1.0 + 0.5 * shake
    return sound


def tone(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """1 kHz and nothing else: the hardest case in which the delays still have one answer."""
    turns = min(1000.0, 0.5 * top_hz) * np.arange(n) / rate_hz + rng.uniform()
    sine: F64 = np.sin(2.0 * np.pi * turns)
    return sine


def knock(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """Knuckles on wood: blows three to seven times a second, each a dozen modes of the panel that die away
    within 5 to 40 ms, the high ones first. Between the blows there is nothing.
    """
    out = np.zeros(n)
    start = int(0.3 * rng.uniform() * min(n, 0.15 * rate_hz))
    modes_hz = np.exp(rng.uniform(np.log(250.0), np.log(min(3000.0, 0.8 * top_hz)), (12, 1)))
    while start < n:
        t = np.arange(min(n - start, round(0.25 * rate_hz))) / rate_hz
        ringing = np.exp(-t * modes_hz / rng.uniform(8.0, 16.0))
        panel = rng.standard_normal(12) @ (ringing * np.sin(2.0 * np.pi * modes_hz * t))
        # a knuckle is soft: it pushes for half a millisecond, so nothing begins at once
        out[start : start + len(t)] += rng.uniform(0.6, 1.0) * panel * -np.expm1(-((t / 5e-4) ** 2))
        start += round(rng.uniform(0.14, 0.33) * rate_hz)
    return _below(out, rate_hz, top_hz)


def instrument(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """A melody on one instrument: notes of two octaves above middle C, plucked or blown, each with harmonics
    that fall as a power of their number, and a slight vibrato.
    """
    out = np.zeros(n)
    fall, attack_s, decay_s = rng.uniform(0.8, 1.8), rng.uniform(0.004, 0.04), rng.uniform(0.1, 2.0)
    start = 0
    while start < n:
        length = round(rng.uniform(0.2, 0.6) * rate_hz)
        if n - start < 1.5 * length:  # no crumbs
            length = n - start
        note_hz = 261.63 * 2.0 ** (rng.integers(25) / 12.0)
        harmonics = np.arange(1, max(2, int(top_hz / (1.01 * note_hz)) + 1))
        t = np.arange(length) / rate_hz
        pitch = note_hz * (1.0 + 0.005 * np.sin(2.0 * np.pi * 5.5 * t))
        loudness = -np.expm1(-((t / attack_s) ** 2)) * np.exp(-t / decay_s)
        loudness *= np.minimum((length - np.arange(length)) / (0.01 * rate_hz), 1.0)
        out[start : start + length] = loudness * wave(
            wavetable(harmonics**-fall, rng), turns_of(pitch, rate_hz)
        )
        start += length
    return out


def _below(sound: F64, rate_hz: float, top_hz: float) -> F64:
    """The same without what lies above `top_hz`."""
    spectrum = np.fft.rfft(sound)
    spectrum[np.fft.rfftfreq(len(sound), 1.0 / rate_hz) > top_hz] = 0.0
    below: F64 = np.fft.irfft(spectrum, len(sound))
    return below


CALLS: dict[str, Call] = {
    "white": white,
    "speech": speech,
    "scream": scream,
    "whistle": whistle,
    "tone": tone,
    "knock": knock,
    "instrument": instrument,
}
