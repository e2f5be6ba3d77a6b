"""The twin's waveforms obey the physics they claim, measured by other means than those that made them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from scenes import arrivals_s, to_db

from locagen_edge.errors import DatasetError, SettingsError
from locagen_edge.geometry import MicArray, equilateral, speed_of_sound
from locagen_edge.lab import recordings as recorded_sounds
from locagen_edge.lab.columns import columns, waveforms
from locagen_edge.lab.settings import LabSettings
from locagen_edge.settings import from_table
from locagen_edge.sim.arrivals import TwinSettings
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.converter import convert, drifted
from locagen_edge.sim.ground import image_m
from locagen_edge.sim.levels import band_power
from locagen_edge.sim.waveforms import BLOCK_SAMPLES, SOUNDS, SceneSettings, draw, fast_size, turns
from locagen_edge.sim.wind import coherence, power, wind

RATE = 10_000.0
SPEED = speed_of_sound(20.0)
ARRAY = equilateral()
PAIRS = ((0, 1), (0, 2), (1, 2))


def make(n=8192, count=3, seed=5, twin=None, array=ARRAY, first=0, recorded=(), **scene):
    scene = {"bits": 0, **scene}
    return draw(
        array,
        SPEED,
        RATE,
        n,
        TwinSettings(**(twin or {})),
        SceneSettings(**scene),
        count,
        seed,
        first,
        recorded,
    )


def delay_of(early, late, most=4.0):
    """Samples by which `late` lags, at most `most`: where the band's cross-correlation is highest.

    The cross-spectrum is weighted by its own size alone, summed at trial delays and refined by a parabola on
    a grid of 1/200 sample. Hann's window keeps what leaves and enters at the ends small.
    """
    window = np.hanning(len(early))
    cross = np.conj(np.fft.rfft(early * window)) * np.fft.rfft(late * window)
    omega = 2.0 * np.pi * np.fft.rfftfreq(len(early))
    band = (omega > 2.0 * np.pi * 300 / RATE) & (omega < 2.0 * np.pi * 4700 / RATE)
    best = 0.0
    for grid in (np.arange(-most, most, 0.1), np.linspace(-0.2, 0.2, 81)):
        trial = best + grid
        height = np.real(np.exp(1j * np.multiply.outer(trial, omega[band])) @ cross[band])
        k = int(np.clip(height.argmax(), 1, len(trial) - 2))
        left, top, right = height[k - 1 : k + 2]
        best = trial[k] + (right - left) / (2.0 * (2.0 * top - left - right)) * (trial[1] - trial[0])
    return best


# --- delays, gains --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", CALLS)
def test_delays_are_exact(kind):
    drawn = make(sounds=(kind,), twin={"range_m": 40.0, "position_error_m": 0.001, "height_m": 10.0})
    for sound, truth in zip(drawn.sound, drawn.true_delay_s, strict=True):
        for pair, (i, j) in enumerate(PAIRS):
            assert delay_of(sound[i], sound[j]) == pytest.approx(truth[pair] * RATE, abs=0.01)


def test_the_truth_is_the_geometry():
    drawn = make(count=50, n=256, twin={"range_m": 5.0, "position_error_m": 0.0, "height_m": 3.0})
    for k in range(50):
        arrival = arrivals_s(ARRAY, drawn.position_m[k].astype(float), SPEED)
        assert drawn.true_delay_s[k] == pytest.approx([arrival[j] - arrival[i] for i, j in PAIRS], abs=1e-9)
        x, y, z = drawn.position_m[k]
        assert drawn.azimuth_rad[k] == pytest.approx(math.atan2(y, x), abs=1e-6)
        assert drawn.elevation_rad[k] == pytest.approx(-math.atan2(z, math.hypot(x, y)), abs=1e-6)
        assert z == 3.0


def test_the_nearer_microphone_hears_it_louder_as_1_over_r():
    drawn = make(twin={"range_m": 0.5, "position_error_m": 0.0, "source": "sweep", "step_deg": 50.0})
    for sound, place in zip(drawn.sound, drawn.position_m, strict=True):
        distance = np.linalg.norm(ARRAY.positions_m - place, axis=1)
        loudness = np.sqrt(np.mean(sound.astype(float) ** 2, axis=1))
        # three samples of 8192 differ between the microphones
        assert loudness * distance == pytest.approx(np.full(3, (loudness * distance).mean()), rel=2e-3)


def test_microphones_stay_within_their_tolerance_and_move_every_time():
    drawn = make(count=400, n=256, twin={"source": "sweep", "step_deg": 180.0, "position_error_m": 0.001})
    ahead = drawn.true_delay_s[::2, 2] * SPEED  # a source ahead: microphones 1 and 2 are as far
    assert 0.001 < np.abs(ahead).max() <= 0.002 + 1e-6  # each up to 1 mm
    assert np.std(ahead) == pytest.approx(0.001 * math.sqrt(2.0 / 3.0), rel=0.15)  # 200 draws


def test_offsets_and_skew_of_channels_add_to_the_delays():
    offsets = (0.0, 0.3, -1.7)
    drawn = make(twin={"offset_samples": offsets, "position_error_m": 0.0})
    for sound, truth in zip(drawn.sound, drawn.true_delay_s, strict=True):
        for pair, (i, j) in enumerate(PAIRS):
            expected = truth[pair] * RATE + offsets[j] - offsets[i]
            assert delay_of(sound[i], sound[j], 6.0) == pytest.approx(expected, abs=0.01)
    drawn = make(count=8, twin={"phase": "each", "position_error_m": 0.0})
    skew = [delay_of(s[0], s[1]) - t[0] * RATE for s, t in zip(drawn.sound, drawn.true_delay_s, strict=True)]
    assert np.all(np.abs(skew) < 1.01)
    assert np.std(skew) > 0.1


def test_gains_are_as_set():
    twin = {"position_error_m": 0.0, "range_m": 1000.0}
    plain, louder = make(twin=twin), make(twin=twin, gain_db=(0.0, 6.0, -20.0))
    ratio = np.sqrt(np.mean(louder.sound**2, axis=2) / np.mean(plain.sound**2, axis=2))
    assert 20.0 * np.log10(ratio) == pytest.approx(np.tile([0.0, 6.0, -20.0], (3, 1)), abs=0.01)
    wrong = make(count=64, n=256, twin=twin, gain_error_db=3.0).sound
    level = 10.0 * np.log10(np.mean(wrong**2, axis=2))
    assert 4.0 < np.ptp(level[:, 0] - level[:, 1]) < 12.0  # each gain is off by up to 3 dB


# --- levels ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "snr_db"), [("white", -5.0), ("white", 20.0), ("speech", 10.0), ("knock", 0.0)]
)
def test_snr_is_as_set_in_every_microphone_and_noises_are_strangers(kind, snr_db):
    drawn = make(sounds=(kind,), twin={"noise": "snr", "snr_db": snr_db, "range_m": 50.0})
    noise = drawn.sound - drawn.call
    for call, rest in zip(drawn.call, noise, strict=True):
        for mic in range(3):
            # of 8192 samples' noise 7200 are in the band: 0.07 dB 1-sigma
            measured = to_db(band_power(call[mic], RATE) / band_power(rest[mic], RATE))
            assert measured == pytest.approx(snr_db, abs=0.4)
        assert np.abs(np.corrcoef(rest) - np.eye(3)).max() < 0.05  # 1 / sqrt(8192) is 0.011
    assert drawn.snr_db == pytest.approx(snr_db, abs=1e-4)
    assert to_db(band_power(drawn.call, RATE)) == pytest.approx(-30.0, abs=0.2)


def test_snr_follows_range_where_it_is_that_at_a_range_and_spans_where_it_has_a_span():
    drawn = make(count=200, n=256, twin={"noise": "snr", "snr_db": 10.0}, snr_at_m=10.0)
    distance = np.linalg.norm(drawn.position_m, axis=1)
    assert drawn.snr_db == pytest.approx(10.0 - 20.0 * np.log10(distance / 10.0), abs=1e-3)
    drawn = make(count=400, n=256, twin={"noise": "snr", "snr_db": -10.0}, snr_span_db=40.0)
    assert -10.0 <= drawn.snr_db.min() < -8.0
    assert 28.0 < drawn.snr_db.max() <= 30.0


def test_without_noise_there_is_none():
    drawn = make(twin={"noise": "none"})
    assert (drawn.sound == drawn.call).all()
    assert np.isinf(drawn.snr_db).all()


def test_white_slopes_as_set_and_ends_where_it_is_told():
    drawn = make(count=40, slope=2.0, top_hz=3000.0)
    spectrum = np.mean(np.abs(np.fft.rfft(drawn.call[:, 0] * np.hanning(8192), axis=1)) ** 2, axis=0)
    frequency = np.fft.rfftfreq(8192, 1 / RATE)
    octave = [spectrum[abs(frequency - hz) < 100].mean() for hz in (1300.0, 2600.0)]
    assert to_db(octave[0] / octave[1]) == pytest.approx(6.0, abs=0.4)
    assert spectrum[frequency > 3020].sum() < 1e-6 * spectrum.sum()


def test_before_the_call_there_is_noise_alone():
    drawn = make(n=6000, sounds=("scream",), lead_s=0.3, twin={"noise": "snr", "snr_db": 20.0})
    assert (drawn.onset == 3000).all()
    before, after = drawn.call[:, :, :2980], drawn.call[:, :, 3020:]
    assert np.mean(before**2) < 1e-5 * np.mean(after**2)  # what a band that ends at 4800 Hz rings
    assert np.mean(drawn.sound[:, :, :2980] ** 2) == pytest.approx(
        np.mean((drawn.sound - drawn.call) ** 2), rel=0.1
    )


def test_rotors_have_their_level_and_are_louder_where_they_are_near():
    drawn = make(n=4096, count=6, rotors=4, rotor_snr_db=-12.0, twin={"range_m": 50.0})
    rotors = drawn.sound - drawn.call
    measured = [
        to_db(band_power(c, RATE) / band_power(r, RATE)) for c, r in zip(drawn.call, rotors, strict=True)
    ]
    assert np.mean(measured) == pytest.approx(-12.0, abs=1.0)  # rotors wander, and their tones beat
    one = make(n=4096, count=1, rotors=1, rotor_arm_m=0.2, twin={"position_error_m": 0.0})
    heard = np.sqrt(np.mean((one.sound - one.call)[0] ** 2, axis=1))
    distance = np.linalg.norm(ARRAY.positions_m - [-0.2, 0.0, 0.0], axis=1)  # the hub of one rotor is behind
    assert heard * distance == pytest.approx(np.full(3, (heard * distance).mean()), rel=0.01)


# --- ground, wind ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("coefficient", [0.7, -0.5])
def test_the_ground_sends_a_second_sound_later_weaker_and_with_its_sign(coefficient):
    twin = {"range_m": 8.0, "height_m": 3.0, "position_error_m": 0.0, "source": "sweep", "step_deg": 70.0}
    plain = make(twin=twin, ground=1e-7, mouth_m=1.2).call.astype(float)  # the same noise: the same period
    both = make(twin=twin, ground=coefficient, mouth_m=1.2)
    for k, source in enumerate(both.position_m.astype(float)):
        mirror = np.array([*source[:2], source[2] + 2.4])  # z is down: 1.2 m of air, and as much again
        assert image_m(source, source[2] + 1.2) == pytest.approx(mirror)
        for mic, place in enumerate(ARRAY.positions_m):
            near, far = np.linalg.norm(source - place), np.linalg.norm(mirror - place)
            late = (far - near) / SPEED * RATE
            echo = both.call[k, mic] - plain[k, mic]
            whole = round(late)
            upright = math.copysign(1.0, coefficient) * echo[whole:]
            assert delay_of(plain[k, mic, :-whole], upright) == pytest.approx(late - whole, abs=0.01)
            ratio = math.sqrt(np.mean(echo[whole:] ** 2) / np.mean(plain[k, mic, :-whole] ** 2))
            assert ratio == pytest.approx(abs(coefficient) * near / far, rel=0.01)


def test_winds_coherence_falls_with_distance_and_with_frequency():
    frequency = np.array([5.0, 20.0, 80.0])
    line = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.20, 0.0, 0.0]])
    for heading in (0.0, 0.8, math.pi / 2):
        level = np.abs(coherence(line, np.array(heading), frequency, 5.0))
        assert (np.diff(level[:, 0, 1]) < 0).all()
        assert (np.diff(level[:, 0, 2]) < 0).all()
        assert (level[:, 0, 2] < level[:, 0, 1]).all()
    along, across = (
        np.abs(coherence(line, np.array(h), frequency, 5.0))[1, 0, 1] for h in (0.0, math.pi / 2)
    )
    assert along > across  # eddies live longer than they are wide


def test_wind_sounds_with_that_coherence_delay_and_spectrum():
    rng = np.random.default_rng(0)
    size, count = 4096, 300
    frequency = np.fft.rfftfreq(size, 1 / RATE)[:400]
    places = np.broadcast_to(np.array([[0.0, 0, 0], [0.03, 0, 0], [0.0, 0.03, 0]]), (count, 3, 3))

    class Steady:
        """Wind from one side only."""

        uniform = staticmethod(lambda *limits_and_shape: np.full(limits_and_shape[-1], 0.4))
        standard_normal = staticmethod(rng.standard_normal)

    spectra = wind(places, frequency, size, 8.0, Steady())
    measured = np.einsum("kif,kjf->fij", spectra, spectra.conj()) / count
    own = np.sqrt(np.einsum("fii->fi", measured).real[1:])
    expected = coherence(places[0], np.array(0.4), frequency[1:], 8.0)
    found = measured[1:] / (own[:, :, None] * own[:, None, :])
    assert np.abs(found - expected).max() < 5.0 / math.sqrt(count)
    level = own[:, 0] ** 2 / power(frequency[1:], 8.0)
    assert np.std(level / level.mean()) < 3.0 / math.sqrt(count)
    steep = power(np.array([200.0, 400.0]), 8.0)
    assert to_db(steep[0] / steep[1]) == pytest.approx(5.0, abs=0.1)  # -5/3: 5 dB an octave
    sound = np.fft.irfft(spectra, size)
    assert np.mean(sound**2) == pytest.approx(1.0, rel=0.1)


def test_wind_has_its_level_in_the_mixture():
    drawn = make(count=20, wind_m_s=5.0, wind_dbfs=-20.0)
    assert to_db(np.mean((drawn.sound - drawn.call) ** 2)) == pytest.approx(-20.0, abs=1.0)


# --- converter ------------------------------------------------------------------------------------------


@given(st.integers(2, 24), st.lists(st.floats(-3.0, 3.0, width=32), min_size=1, max_size=50))
def test_words_are_steps_within_full_scale_and_the_nearest_ones(bits, values):
    sound = np.array(values, dtype=np.float32)
    before = sound.copy()
    words = convert(sound, bits)
    step = 2.0 ** (1 - bits)
    assert (sound == before).all()
    assert words.dtype == np.float32
    assert (words.astype(float) / step == np.rint(words.astype(float) / step)).all()
    assert (words >= -1.0).all()
    assert (words <= 1.0 - step).all()
    inside = (sound >= -1.0) & (sound <= 1.0 - step)
    assert (np.abs(words - sound)[inside] <= step / 2.0).all()
    assert (convert(words, bits) == words).all()
    order = np.argsort(sound)
    assert (np.diff(words[order]) >= 0.0).all()


def test_no_word_length_is_an_ideal_converter():
    sound = np.array([-2.0, 0.123456789, 2.0], dtype=np.float32)
    assert (convert(sound, 0) == sound).all()


def test_a_loud_call_clips_and_short_words_are_noise_of_a_twelfth_of_a_step_squared():
    loud = make(level_dbfs=0.0, bits=16).sound
    assert loud.min() == -1.0
    assert loud.max() == 1.0 - 2.0**-15
    coarse = make(level_dbfs=-30.0, bits=10)
    error = coarse.sound - coarse.call
    assert np.mean(error.astype(float) ** 2) == pytest.approx((2.0**-9) ** 2 / 12.0, rel=0.05)


def test_reading_at_other_moments_reads_the_wave_itself():
    size = 4096
    spectrum = np.zeros((1, size // 2 + 1), dtype=np.complex64)
    spectrum[0, 1700] = size / 2.0  # 0.415 of the sample rate
    at = 50.0 + 1.0003 * np.arange(3900)
    read = drifted(spectrum, size, at[np.newaxis])
    assert read[0] == pytest.approx(np.cos(2.0 * np.pi * 1700 / size * at), abs=3e-4)


def test_clocks_drift_steadily_from_when_the_call_began():
    ppm, n = 300.0, 40_000
    drawn = make(n=n, count=1, twin={"position_error_m": 0.0, "range_m": 100.0, "clock_ppm": ppm})
    travel = float(np.linalg.norm(drawn.position_m[0])) / SPEED * RATE
    rates = []
    for pair, (i, j) in enumerate(PAIRS):
        parts = [slice(start, start + 2000) for start in range(0, n, 2000)]
        late = np.array([delay_of(drawn.sound[0, i, p], drawn.sound[0, j, p], 30.0) for p in parts])
        late -= drawn.true_delay_s[0, pair] * RATE
        # within a part the delay changes by up to 1.2 samples; its middle counts
        since = np.array([travel + p.start + 1000 for p in parts])
        rates.append(np.sum(late * since) / np.sum(since**2))
        assert np.abs(late - rates[-1] * since).max() < 0.1
    assert rates[0] + rates[2] == pytest.approx(rates[1], abs=1e-6)
    assert 1e-5 < max(map(abs, rates)) <= 2.0 * ppm * 1e-6


# --- the row of samples -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"sounds": ("speech", "white", "knock"), "ground": 0.4, "snr_span_db": 20.0, "gain_error_db": 1.0},
        {"rotors": 2, "wind_m_s": 3.0},
    ],
)
def test_a_sample_is_the_same_whoever_draws_it(more):
    n = 4096
    twin = {"noise": "snr", "clock_ppm": 20.0, "phase": "each"}
    block = BLOCK_SAMPLES // n
    whole = make(n=n, count=2 * block, twin=twin, **more)
    part = make(n=n, count=4, first=block - 2, twin=twin, **more)
    for name in ("sound", "call", "kind", "snr_db", "true_delay_s", "azimuth_rad", "onset"):
        assert (getattr(whole, name)[block - 2 : block + 2] == getattr(part, name)).all()
    assert not (make(n=n, count=4, first=block - 2, twin=twin, seed=6, **more).sound == part.sound).any()
    assert len({row.tobytes() for row in whole.sound}) == 2 * block


def test_a_sweep_goes_round_in_tenths_of_a_degree():
    drawn = make(n=256, count=3600, twin={"source": "sweep", "step_deg": 0.1})
    degrees = np.degrees(drawn.azimuth_rad.astype(float)) % 360.0
    assert np.sort(np.rint(degrees * 10.0).astype(int) % 3600).tolist() == list(range(3600))
    assert np.abs(degrees * 10.0 - np.rint(degrees * 10.0)).max() < 1e-3


def test_a_disc_is_filled_evenly():
    drawn = make(n=256, count=4000, twin={"range_m": 100.0})
    distance = np.linalg.norm(drawn.position_m[:, :2], axis=1)
    assert distance.min() >= 0.5
    shares = np.histogram((distance / 100.0) ** 2, bins=8, range=(0, 1))[0] / 4000
    assert shares == pytest.approx(np.full(8, 0.125), abs=0.02)  # 4 sigma


def test_every_kind_that_may_sound_does():
    drawn = make(n=512, count=80, sounds=("white", "knock", "instrument", "tone"))
    assert set(drawn.kind) == {"white", "knock", "instrument", "tone"}
    assert np.isfinite(drawn.sound).all()
    assert (np.abs(drawn.sound).max(axis=(1, 2)) > 1e-3).all()


@pytest.mark.parametrize("rate_hz", [8000.0, 24_000.0, 44_100.0, 48_000.0])
def test_other_rates_and_arrays(rate_hz):
    array = MicArray(np.array([[0.0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0.1, 0.1, 0.1]]))
    twin = TwinSettings(position_error_m=0.0, offset_samples=(0.0,) * 4)
    scene = SceneSettings(gain_db=(0.0,) * 4)
    drawn = draw(array, SPEED, rate_hz, 1024, twin, scene, 5, 1)
    assert drawn.sound.shape == (5, 4, 1024)
    assert drawn.true_delay_s.shape == (5, 6)


@given(st.integers(2, 200_000))
def test_fft_sizes_are_even_enough_and_smooth(least):
    size = fast_size(least)
    assert least <= size <= max(2 * least, 2)
    assert size % 2 == 0
    for prime in (2, 3, 5):
        while size % prime == 0:
            size //= prime
    assert size == 1


@given(st.floats(-200.0, 200.0), st.integers(1, 700))
def test_the_factored_delay_is_the_delay(delay, bins):
    direct = np.exp(-2j * np.pi * np.arange(bins) * delay / 1152)
    assert np.abs(turns(np.array([delay]), 1152, bins)[0] - direct).max() < 1e-6


# --- new calls --------------------------------------------------------------------------------------------


def test_knocks_are_blows_with_silence_between():
    sound = CALLS["knock"](30_000, RATE, 4800.0, np.random.default_rng(1))
    loudness = np.sqrt(np.mean(sound.reshape(-1, 100) ** 2, axis=1))  # every 10 ms
    loud = loudness > 0.25 * loudness.max()
    blows = int(np.sum(np.diff(loud.astype(int)) == 1))
    assert 3 / 1.5 * 3 <= blows <= 3 * 8
    assert np.mean(loudness < 0.05 * loudness.max()) > 0.3


def test_an_instrument_plays_notes_of_the_tempered_scale():
    sound = CALLS["instrument"](60_000, RATE, 4800.0, np.random.default_rng(2))
    on_scale = []
    for start in range(0, 58_000, 2048):
        spectrum = np.abs(np.fft.rfft(sound[start : start + 2048] * np.hanning(2048), 1 << 15))
        semitones = 12.0 * math.log2(spectrum.argmax() * RATE / (1 << 15) / 261.63)
        on_scale.append(abs(semitones - round(semitones)) < 0.15)
    assert np.mean(on_scale) > 0.7  # some pieces hold two notes, or a harmonic that is not of the scale


# --- recorded sounds --------------------------------------------------------------------------------------


def test_files_sound_with_their_names(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "deep").mkdir()
    soundfile.write(tmp_path / "b.wav", 0.1 * rng.standard_normal((8000, 2)), 16000)
    soundfile.write(
        tmp_path / "deep" / "a.flac", 0.1 * rng.standard_normal(500), 16000
    )  # shorter than a frame
    soundfile.write(tmp_path / "silence.wav", np.zeros(1000), 16000)
    table = {
        "scene": {"sounds": ["recorded", "white"], "recordings": str(tmp_path)},
        "twin": {"range_m": 30.0},
    }
    drawn = waveforms(from_table(table, LabSettings), 60, 1)
    assert set(drawn.kind) == {"recorded:b.wav", "recorded:deep/a.flac", "white"}
    assert to_db(band_power(drawn.call, RATE)) == pytest.approx(-30.0, abs=0.1)
    for k in np.flatnonzero(drawn.kind == "recorded:b.wav")[:5]:
        assert delay_of(drawn.call[k, 0], drawn.call[k, 1]) == pytest.approx(
            drawn.true_delay_s[k, 0] * RATE, abs=0.02
        )


def test_a_folder_without_sounds_is_refused(tmp_path):
    for name in ("", "no.wav"):
        if name:
            (tmp_path / name).write_text("not sound")
        with pytest.raises(DatasetError, match=r"holds no|no\.wav"):
            recorded_sounds.load.__wrapped__(str(tmp_path), 10_000)


def test_real_recordings(recordings, tmp_path):
    files = sorted((recordings / "signal").rglob("*.flac"))[::60]
    for k, file in enumerate(files):
        (tmp_path / f"{k}{file.suffix}").symlink_to(file)
    table = {
        "scene": {"sounds": ["recorded"], "recordings": str(tmp_path), "bits": 0},
        "twin": {"range_m": 30.0},
    }
    drawn = waveforms(from_table(table, LabSettings), 30, 1)
    assert len(set(drawn.kind)) > 3
    errors = [
        delay_of(call[0], call[1]) - truth[0] * RATE
        for call, truth in zip(drawn.call, drawn.true_delay_s, strict=True)
    ]
    assert np.median(np.abs(errors)) < 0.01


# --- through the flight's own stages ------------------------------------------------------------------------


def test_the_flights_stages_find_the_delays():
    table = {
        "twin": {"noise": "snr", "snr_db": 20.0},
        "dataset": {"level": "waveforms", "keep": ["correlation"]},
    }
    drawn = columns(from_table(table, LabSettings), 200, 1)
    error = (drawn["delay_s"] - drawn["true_delay_s"]) * RATE
    assert drawn["delay_s"].shape == (200, 3)
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.std(error / RATE / drawn["sigma_s"]) < 1.3  # what the flight states is not too little
    assert drawn["correlation"].shape[:2] == (200, 3)
    assert drawn["correlation"].max(axis=2) == pytest.approx(drawn["peak"], abs=0.02)


def test_long_samples_have_all_their_frames():
    table = {
        "scene": {"frames": 5, "lead_s": 0.15},
        "twin": {"noise": "snr", "snr_db": 20.0},
        "dataset": {"level": "waveforms", "keep": ["sound", "call"]},
    }
    drawn = columns(from_table(table, LabSettings), 4, 1)
    assert drawn["sound"].shape == drawn["call"].shape == (4, 3, 1024 + 4 * 512)
    assert drawn["delay_s"].shape == (4, 5, 3)
    assert drawn["power"].shape == (4, 5, 3)
    assert drawn["calling"].tolist() == [[False, False, True, True, True]] * 4  # 1500 samples of noise first
    error = (drawn["delay_s"][:, 3:] - drawn["true_delay_s"][:, None]) * RATE
    assert np.abs(error).max() < 0.1


# --- what cannot be ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"scene": {"sounds": ["recorded"]}}, "scene.recordings"),
        ({"scene": {"sounds": []}}, "scene.sounds"),
        ({"scene": {"sounds": ["thunder"]}}, "scene.sounds"),
        ({"scene": {"throttle": [0.7, 0.3]}}, "scene.throttle"),
        ({"scene": {"gain_db": [0.0]}}, "scene.gain_db"),
        ({"scene": {"lead_s": 1.0}}, "scene.lead_s"),
        ({"scene": {"rotors": 4, "rotor_arm_m": 0.06}}, "scene.rotor_arm_m"),
        ({"scene": {"ground": 1.5}}, "scene.ground"),
        ({"scene": {"bits": 32}}, "scene.bits"),
        ({"twin": {"noise": "fixed"}, "dataset": {"level": "waveforms"}}, "twin.noise"),
        ({"dataset": {"keep": ["everything"]}}, "dataset.keep"),
        ({"dataset": {"shard": 0}}, "dataset.shard"),
    ],
)
def test_what_cannot_be_is_refused_by_name(table, key):
    with pytest.raises(SettingsError) as caught:
        from_table(table, LabSettings)
    assert key in {line.partition(":")[0] for line in str(caught.value).splitlines()}


def test_all_faults_of_a_scene_are_told_at_once():
    table = {"scene": {"sounds": ["recorded"], "throttle": [1.0, 0.0], "lead_s": 9.0, "wind_m_s": -1.0}}
    with pytest.raises(SettingsError) as caught:
        from_table(table, LabSettings)
    told = str(caught.value)
    for key in itertools.chain(
        ["scene.recordings"], (f"scene.{k}" for k in ("throttle", "lead_s", "wind_m_s"))
    ):
        assert f"{key}:" in told


def test_every_sound_has_a_name_in_the_manual():
    assert set(SOUNDS) == {*CALLS, "recorded"}
