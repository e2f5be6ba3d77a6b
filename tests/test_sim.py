"""The synthetic world obeys the physics it claims, measured by other means than those that made it."""

import asyncio
import itertools
import math

import numpy as np
import pytest
from scenes import arrivals_s, to_db

from locagen_edge.geometry import direction, equilateral, speed_of_sound
from locagen_edge.settings import from_table
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.levels import band_power
from locagen_edge.sim.propagation import (
    REACH,
    delayed,
    interpolate,
    interpolate_steadily,
    paths,
    place,
    plane_wave,
)
from locagen_edge.sim.rotors import BladeRate, hubs_m, rotor
from locagen_edge.sim.scene import Scene, frames, sim
from locagen_edge.sim.synth import band_noise, joined

RATE = 10_000.0
SPEED = speed_of_sound(20.0)


def make(**sim_settings):
    return from_table({"sim": sim_settings})


def band_noise_10k(n, seed=0):
    """Noise (n,) for delays to be measured on, zero near its ends."""
    return band_noise(n, RATE, 300.0, 4700.0, np.random.default_rng(seed)) * np.hanning(n)


def measured_delay(early, late, rate_hz=RATE):
    """Samples by which `late` lags: slope of the cross-spectrum's phase, in float64, over 300 to 4700 Hz.

    The coarse delay is the peak of the cross-correlation; it only unwraps the phase.
    """
    n = 1 << (2 * len(early) - 1).bit_length()
    cross = np.conj(np.fft.rfft(early.astype(np.float64), n)) * np.fft.rfft(late.astype(np.float64), n)
    coarse = int(np.argmax(np.fft.irfft(cross)))
    coarse -= n * (coarse > n // 2)
    frequency = np.fft.rfftfreq(n, 1.0 / rate_hz)
    band = (frequency > 300) & (frequency < 4700)
    omega = 2.0 * np.pi * frequency[band] / rate_hz
    phase = np.angle(cross[band] * np.exp(1j * omega * coarse))
    weight = np.abs(cross[band])
    return coarse - np.sum(weight * omega * phase) / np.sum(weight * omega**2)


# --- propagation --------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [7.0, -7.0, 0.0, 2.915, -0.37, 1000.25])
def test_a_delay_is_what_was_asked(delay):
    signal = band_noise_10k(8192)
    (moved,) = delayed(signal, np.array([delay]))
    assert measured_delay(signal, moved) == pytest.approx(delay, abs=1e-3)


def test_whole_delays_shift_cut_off_and_never_wrap():
    signal = band_noise_10k(500)
    right, left, gone = delayed(signal, np.array([7.0, -7.0, 600.0]))
    np.testing.assert_allclose(right[7:], signal[:-7], atol=1e-12)
    np.testing.assert_allclose(left[:-7], signal[7:], atol=1e-12)
    np.testing.assert_allclose(right[:7], 0, atol=1e-12)
    np.testing.assert_allclose(gone, 0, atol=1e-12)


def test_silence_stays_silent():
    assert not delayed(np.zeros(100), np.array([0.3, -7.0])).any()


def test_an_array_received_is_left_as_it_is():
    signal = band_noise_10k(256)
    before = signal.copy()
    place(signal, RATE, equilateral().positions_m, np.array([3.0, 1.0, 2.0]), SPEED)
    np.testing.assert_array_equal(signal, before)


@pytest.mark.parametrize("azimuth_deg", range(0, 360, 45))
def test_a_plane_wave_has_the_delays_of_the_geometry(azimuth_deg):
    array = equilateral()
    u = direction(math.radians(azimuth_deg), -0.4)
    heard = plane_wave(band_noise_10k(4096), RATE, array.positions_m, u, SPEED)
    for (i, j), delay_s in zip(array.pairs, array.delays_s(u, SPEED), strict=True):
        assert measured_delay(heard[i], heard[j]) == pytest.approx(delay_s * RATE, abs=1e-3)


def test_the_right_microphone_hears_a_source_on_the_right_first():
    array = equilateral()  # ahead, behind right, behind left
    heard = place(band_noise_10k(4096), RATE, array.positions_m, np.array([0.0, 20.0, 5.0]), SPEED)
    assert measured_delay(heard[1], heard[2]) > 2.0


def test_near_sources_follow_their_true_distances():
    array = equilateral()
    source_m = np.array([0.2, 0.1, 0.05])
    signal = band_noise_10k(4096)
    heard = place(signal, RATE, array.positions_m, source_m, SPEED)
    arrivals = arrivals_s(array, source_m, SPEED) * RATE
    for mic in (1, 2):
        assert measured_delay(heard[0], heard[mic]) == pytest.approx(arrivals[mic] - arrivals[0], abs=1e-3)
    level = np.sqrt(np.mean(heard**2, axis=1) / np.mean(signal**2))
    distance = np.linalg.norm(array.positions_m - source_m, axis=1)
    np.testing.assert_allclose(level, np.linalg.norm(source_m) / distance, rtol=1e-3)


def test_twice_as_far_is_half_as_loud_and_twice_as_late():
    mics = np.zeros((1, 3))
    delay_s, gain = paths(mics, np.array([[10.0, 0, 0], [0, 20.0, 0]]), SPEED)
    assert delay_s[:, 0] == pytest.approx([10 / SPEED, 20 / SPEED])
    assert gain[0, 0] / gain[1, 0] == pytest.approx(2.0)


@pytest.mark.parametrize("hz", [300.0, 2000.0, 4700.0])
def test_interpolation_errs_below_80_db(hz):
    made_hz = 2 * RATE
    signal = np.sin(2 * np.pi * hz * np.arange(3000) / made_hz).astype(np.float32)
    at = np.sort(np.random.default_rng(0).uniform(REACH, len(signal) - 1 - REACH, 4000))
    error = interpolate(signal, at) - np.sin(2 * np.pi * hz * at / made_hz)
    assert np.abs(error).max() < 1e-4


def test_steady_interpolation_is_interpolation():
    signal = np.random.default_rng(0).standard_normal(500).astype(np.float32)
    first = np.array([20.0, 21.37, 30.99999])
    at = first[:, np.newaxis] + 2 * np.arange(200)
    np.testing.assert_allclose(
        interpolate_steadily(signal, first, 2, 200), interpolate(signal, at), atol=1e-5
    )


# --- signals ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", CALLS)
@pytest.mark.parametrize("seconds", [0.05, 0.3, 1.5])
def test_calls_sound_in_the_band_and_nowhere_above_it(kind, seconds):
    made_hz, top_hz = 2 * RATE, 4800.0
    n = round(seconds * made_hz)
    sound = CALLS[kind](n, made_hz, top_hz, np.random.default_rng(3))
    assert sound.shape == (n,)
    assert np.isfinite(sound).all()
    spectrum = np.abs(np.fft.rfft(sound * np.hanning(n))) ** 2
    # aliases would begin at 5.2 kHz; -60 dB of the whole leaves nothing to hear
    assert spectrum[np.fft.rfftfreq(n, 1 / made_hz) > 5200].sum() < 1e-6 * spectrum.sum()
    assert band_power(sound, made_hz) > 0.3 * np.mean(sound**2)


def test_band_noise_has_power_one_and_keeps_to_its_band():
    noise = band_noise(100_000, RATE, 500.0, 3000.0, np.random.default_rng(0), slope=1.0)
    assert np.mean(noise**2) == pytest.approx(1.0, rel=0.05)
    power = np.abs(np.fft.rfft(noise * np.hanning(len(noise)))) ** 2
    frequency = np.fft.rfftfreq(len(noise), 1 / RATE)
    assert power[(frequency < 450) | (frequency > 3050)].sum() < 1e-6 * power.sum()
    octave = [power[abs(frequency - hz) < 100].mean() for hz in (1400.0, 2800.0)]
    assert to_db(octave[0] / octave[1]) == pytest.approx(3.0, abs=0.7)  # 2000 bins: 0.2 dB of chance each


def test_joined_pieces_keep_their_power_and_length():
    rng = np.random.default_rng(0)
    sound = np.concatenate(list(joined((rng.standard_normal(5000) for _ in range(8)), 1000)))
    assert len(sound) == 8 * 5000 - 7 * 1000
    seams = sound[4000:-5000].reshape(-1, 1000)
    assert np.mean(seams**2, axis=1) == pytest.approx(1.0, abs=0.2)  # 1000 draws: 4.5 % of chance


def test_a_rotor_has_its_harmonics_and_noise_between():
    throttle, seed = 0.5, 5
    blades = BladeRate(throttle, np.random.default_rng(seed))
    made_hz = 2 * RATE
    pieces = itertools.islice(rotor(throttle, made_hz, 4800.0, np.random.default_rng(seed)), 12)
    sound = np.concatenate(list(pieces))
    assert to_db(band_power(sound, made_hz)) == pytest.approx(0.0, abs=0.5)
    # Turned back by the blades' own phase, a harmonic stands still: its mean is its amplitude.
    turns = blades.turns(np.arange(len(sound)) / made_hz)
    heights = [abs(np.mean(sound * np.exp(-2j * np.pi * order * turns))) for order in (1, 2, 3, 8)]
    between = [abs(np.mean(sound * np.exp(-2j * np.pi * order * turns))) for order in (1.5, 2.5, 8.5)]
    assert np.diff(heights).max() < 0  # each weaker than the one below
    assert heights[1] / heights[0] == pytest.approx(0.5, rel=0.05)
    assert min(heights[:3]) > 10 * max(between)
    rate_hz = np.gradient(turns, 1 / made_hz)
    assert np.all(abs(rate_hz / blades.mean_hz - 1) < 0.016)


def test_hubs_sit_on_their_arm():
    hubs = hubs_m(4, 0.3)
    np.testing.assert_allclose(np.linalg.norm(hubs, axis=1), 0.3)
    np.testing.assert_allclose(np.degrees(np.arctan2(hubs[:, 1], hubs[:, 0])) % 360, [45, 135, 225, 315])
    assert hubs_m(0, 0.3).shape == (0, 3)


# --- scene --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [[1, 5, 4096, 3000], [512] * 14, [7102]])
def test_the_same_seed_gives_the_same_bytes_at_any_block_size(sizes):
    settings = make(call="speech", call_s=0.2, pause_s=0.1)
    whole = Scene(settings).render(sum(sizes))
    scene = Scene(settings)
    cut = np.concatenate([scene.render(n) for n in sizes], axis=1)
    assert cut.tobytes() == whole.tobytes()
    assert whole.dtype == np.float32


def test_another_seed_gives_another_sound():
    assert not np.array_equal(Scene(make(seed=1)).render(1000), Scene(make(seed=2)).render(1000))


def test_a_caller_sounds_the_same_whatever_flies():
    with_rotors, without = (Scene(make(rotors=n, noise_dbfs=-40)).parts(4000)[0] for n in (4, 0))
    np.testing.assert_array_equal(with_rotors, without)


@pytest.mark.parametrize("kind", CALLS)
@pytest.mark.parametrize("snr_db", [-10.0, 5.0])
def test_snr_while_calling_is_as_set(kind, snr_db):
    settings = make(call=kind, snr_db=snr_db, call_s=1.0, pause_s=0.5, distance_m=5.0, height_m=2.0, seed=7)
    scene = Scene(settings)
    seconds = 15
    call, rotors, sensor = scene.parts(int(seconds * RATE))
    calling = np.array([scene.truth(k).calling for k in range(0, int(seconds * RATE), 20)])
    noise_db = to_db(band_power(rotors + sensor, RATE))
    call_db = to_db(band_power(call, RATE) / calling.mean())
    assert call_db - noise_db == pytest.approx(snr_db, abs=0.5)
    assert noise_db == pytest.approx(settings.sim.noise_dbfs, abs=0.4)
    sensor_db = to_db(band_power(sensor, RATE) / band_power(rotors, RATE))
    assert sensor_db == pytest.approx(settings.sim.sensor_db, abs=0.4)


def test_without_rotors_sensor_noise_alone_has_the_level():
    _, rotors, sensor = Scene(make(rotors=0, noise_dbfs=-50.0)).parts(50_000)
    assert not rotors.any()
    assert to_db(band_power(sensor, RATE)) == pytest.approx(-50.0, abs=0.2)
    correlation = np.corrcoef(sensor)
    assert np.abs(correlation - np.eye(3)).max() < 0.02  # 1 / sqrt(50000) is 0.0045


def test_rotors_are_coherent_between_microphones():
    _, rotors, _ = Scene(make()).parts(30_000)
    assert np.corrcoef(rotors)[0, 1] > 0.3


@pytest.mark.parametrize(
    ("azimuth_deg", "turn_deg_s", "distance_m", "height_m"),
    [(40.0, 0.0, 30.0, 15.0), (200.0, 20.0, 10.0, 0.0), (-75.0, -90.0, 3.0, 8.0), (0.0, 6.0, 1.0, 0.3)],
)
def test_delays_are_those_of_the_truth(azimuth_deg, turn_deg_s, distance_m, height_m):
    settings = make(
        call="white", pause_s=0.0, snr_db=60.0, rotors=0,
        azimuth_deg=azimuth_deg, turn_deg_s=turn_deg_s, distance_m=distance_m, height_m=height_m,
    )  # fmt: skip
    scene = Scene(settings)
    sound = scene.render(20_000)
    n = 512
    for start in (3000, 12_345, 18_000):
        window = sound[:, start : start + n] * np.hanning(n)
        source_m = scene.source_m(np.array((start + n / 2) / RATE))
        arrivals = arrivals_s(settings.mic_array, source_m, settings.speed_m_s) * RATE
        for i, j in settings.mic_array.pairs:
            # at 60 dB the bound on one window is 5e-4 samples
            assert measured_delay(window[i], window[j]) == pytest.approx(arrivals[j] - arrivals[i], abs=0.01)


def test_truth_is_the_geometry():
    scene = Scene(make(azimuth_deg=350.0, turn_deg_s=20.0, distance_m=30.0, height_m=15.0))
    truth = scene.truth(RATE)  # one second
    assert math.degrees(truth.azimuth_rad) == pytest.approx(10.0)
    assert math.degrees(truth.elevation_rad) == pytest.approx(-math.degrees(math.atan2(15, 30)))
    assert truth.range_m == pytest.approx(math.hypot(30, 15))


def test_calling_is_true_when_the_call_is_heard():
    settings = make(call="white", call_s=0.5, pause_s=0.5, turn_deg_s=0.0)
    scene = Scene(settings)
    call = scene.parts(30_000)[0][0]
    calling = np.repeat([scene.truth(k).calling for k in range(0, 30_000, 10)], 10)
    travel = math.hypot(30, 15) / settings.speed_m_s * RATE
    assert np.flatnonzero(calling)[0] == pytest.approx(travel, abs=10)
    near_edge = np.convolve(np.abs(np.diff(calling, prepend=False)), np.ones(41), "same") > 0
    loud = np.abs(call) > 1e-3 * np.abs(call).max()
    assert loud[calling & ~near_edge].mean() > 0.95
    # 20 samples: the microphone's offset from the origin and the kernel's reach
    assert not loud[~calling & ~near_edge].any()


@pytest.mark.parametrize("call_s", [0.05, 7.0])
def test_without_a_pause_the_call_never_stops(call_s):
    scene = Scene(make(call="white", call_s=call_s, pause_s=0.0, distance_m=1.0, height_m=0.0))
    call = scene.parts(160_000)[0][0][200:]
    power = np.mean(call[: len(call) // 400 * 400].reshape(-1, 400) ** 2, axis=1)
    assert power.min() > 0.3 * power.mean()
    assert scene.truth(159_999).calling


def test_a_long_call_is_as_long_as_set():
    scene = Scene(make(call="tone", call_s=12.0, pause_s=1.0, distance_m=1.0, height_m=0.0, turn_deg_s=0.0))
    call = scene.parts(140_000)[0][0]
    power = np.mean(call.reshape(-1, 100) ** 2, axis=1)
    silent = np.flatnonzero(power < 1e-6 * power.max())
    assert silent[0] * 100 == pytest.approx(120_030, abs=100)
    assert len(silent) == pytest.approx(100, abs=1)


def test_frames_overlap_and_carry_their_truth():
    settings = from_table({"audio": {"hop": 256}, "sim": {"turn_deg_s": 90.0}})
    got = list(itertools.islice(frames(settings), 30))
    sound = Scene(settings).render(29 * 256 + 1024)
    scene = Scene(settings)
    for k, frame in enumerate(got):
        assert frame.start == 256 * k
        assert frame.t_ns == 25_600_000 * k
        assert frame.overruns == 0
        assert frame.truth == scene.truth(256 * k + 512)
        np.testing.assert_array_equal(frame.samples, sound[:, 256 * k : 256 * k + 1024])


@pytest.mark.parametrize("rate_hz", [4000, 8000, 16_000, 48_000])
def test_other_rates_and_arrays(rate_hz):
    table = {
        "audio": {"rate_hz": rate_hz, "channel_map": [0, 1]},
        "array": {"positions_m": [[0.0, 0.0, 0.0], [0.0, 0.05, 0.0]]},
        "correlation": {"band_hz": [300.0, 1800.0]},
        "bearing": {"estimator": "two-mic"},
    }
    frame = next(frames(from_table(table)))
    assert frame.samples.shape == (2, 1024)
    assert frame.rate_hz == rate_hz
    assert np.isfinite(frame.samples).all()
    assert np.mean(frame.samples**2) > 0


def test_the_source_runs_in_real_time_and_closes():
    async def listen():
        source = sim(make())
        got = [await anext(source) for _ in range(3)]
        await source.aclose()
        return got

    got = asyncio.run(listen())
    assert [f.start for f in got] == [0, 512, 1024]
    assert got[1].t_ns - got[0].t_ns == 51_200_000
    assert got[0].truth is not None
