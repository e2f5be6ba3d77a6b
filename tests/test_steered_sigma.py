"""What `steered` says of its own errors where the microphones are not quite where the settings say."""

import math

import numpy as np
import pytest

from locagen_edge.geometry import direction, wrap
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.steered import LOOKS, SteeredLocator
from locagen_edge.types import Frame, Tdoa

NO_DELAYS = Tdoa(np.zeros(0), np.zeros(0), np.zeros(0))
ARRAYS = 60


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
