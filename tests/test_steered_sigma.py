"""What `steered` says of its own errors where the microphones are not quite where the settings say."""

import math

import numpy as np
import pytest

from locagen_edge.geometry import direction, wrap
from locagen_edge.settings import Settings, from_table
from locagen_edge.sim.propagation import plane_wave
from locagen_edge.stages.bearing.steered import LOOKS, SteeredLocator
from locagen_edge.types import Frame, Tdoa

NO_DELAYS = Tdoa(np.zeros(0), np.zeros(0), np.zeros(0))
ARRAYS = 60
FAINT = 0.5


@pytest.mark.parametrize("elevation_deg", [-60.0, -20.0])
def test_misplaced_microphones_turn_the_bearing_by_as_much_as_it_says(elevation_deg: float) -> None:
    """A loud plane wave in hardly any noise: only the positions, off by N(0, tolerance_m), are wrong."""
    s = Settings()
    rate_hz, n, tolerance_m = s.audio.rate_hz, s.audio.frame, s.array.tolerance_m
    rng = np.random.default_rng(1)
    elevation = math.radians(elevation_deg)
    f = np.fft.rfftfreq(4 * n, 1.0 / rate_hz)
    share = []
    for _ in range(ARRAYS):
        places = s.mic_array.positions_m + tolerance_m * rng.standard_normal((3, 3))
        azimuth = rng.uniform(-math.pi, math.pi)
        spectrum = np.fft.rfft(rng.standard_normal(4 * n)) * ((f >= 300) & (f <= 4000))
        early = places @ direction(azimuth, elevation) / s.speed_m_s
        wave = np.fft.irfft(spectrum * np.exp(2j * np.pi * f * early[:, None]))[:, n : 2 * n]
        locate = SteeredLocator(s)
        looks = 3 * LOOKS + round(0.6 / s.hop_s)
        for number in range(looks + 1):
            sound = 1e-4 * rng.standard_normal((3, n)) + (0.1 * wave if number == looks else 0.0)
            frame = Frame(sound.astype(np.float32), rate_hz, 0, number * s.audio.hop)
            bearing = locate(frame, NO_DELAYS, s.hop_s)[0]
            locate.settle(number == looks)
        assert bearing.azimuth_rad is not None
        assert bearing.elevation_rad is not None
        share.append((
            wrap(bearing.azimuth_rad - azimuth) / bearing.azimuth_sigma_rad,
            (bearing.elevation_rad - elevation) / bearing.elevation_sigma_rad,
        ))  # fmt: skip
    # the rms of 60 normal errors is known to 9 %; at 20 degrees the cosine's curvature adds some
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(share), axis=0)), 1.0, atol=0.25)


def test_a_call_that_fills_part_of_the_average_is_as_well_known_as_it_says() -> None:
    """White calls too faint for one frame, told from the average a quarter of a second after they began."""
    s = from_table({"array": {"tolerance_m": 0.0}})
    rate_hz, n, hop = s.audio.rate_hz, s.audio.frame, s.audio.hop
    begin, told_at = 70 * hop, 75
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(70):
        azimuth = rng.uniform(-math.pi, math.pi)
        sound = rng.standard_normal((3, (told_at + 1) * hop + n))
        call = np.pad(rng.standard_normal(sound.shape[1] - begin), (begin, 0))
        u = direction(azimuth, -0.4)
        sound += FAINT * plane_wave(call, rate_hz, s.mic_array.positions_m, u, s.speed_m_s)
        locate = SteeredLocator(s)
        for number in range(told_at + 1):
            start = number * hop
            samples = np.ascontiguousarray(0.01 * sound[:, start : start + n], np.float32)
            bearing = locate(Frame(samples, rate_hz, 0, start), NO_DELAYS, s.hop_s)[0]
            locate.settle(False)
        if bearing.span_s > 0.0 and bearing.azimuth_rad is not None:
            errors.append(abs(wrap(bearing.azimuth_rad - azimuth)) / bearing.azimuth_sigma_rad)
    assert len(errors) > 40
    # of 60 normal errors 68 % +-12 % at 2 sigma, and 95 %
    assert 0.55 < np.mean(np.array(errors) < 1.0) < 0.82
    assert np.mean(np.array(errors) < 2.0) > 0.88
