"""The daemon as most people would write it: numpy and mavutil, one loop. A peer for bench_daemon.py.

    python bench/plain_daemon.py FILE.wav udpout:127.0.0.1:14550

The recording is played in real time at its own rate, as a loop of blocking reads from a microphone would be.
GCC-PHAT of all pairs with zero-padded FFTs, four points a sample; least squares for a plane wave over the
delays of an equilateral triangle of 10 cm. The bearing goes out as DEBUG_VECT: its time is that of the
sound's last sample (us, monotonic), x the azimuth in degrees, y the mean peak.

It knows no rotors, tracks, sigmas, faults or reconnections; it is what all of that is measured beside.
"""

import itertools
import sys
import time

import numpy as np
import soundfile
from pymavlink import mavutil

SPEED_M_S = 343.0
FRAME, HOP = 4096, 2048
INTERP = 4
BAND_HZ = (300.0, 4700.0)
LEAST_PEAK = 0.15

MICS = np.array([[0.057735, 0.0], [-0.028868, 0.05], [-0.028868, -0.05]])
PAIRS = list(itertools.combinations(range(len(MICS)), 2))
SLOPE = np.array([MICS[i] - MICS[j] for i, j in PAIRS]) / SPEED_M_S


def gcc_phat(frame, rate_hz):
    """Delays in seconds and heights of the peaks, of all pairs of a frame (samples, mics)."""
    n = 2 * len(frame)
    spectra = np.fft.rfft(frame * np.hanning(len(frame))[:, None], n, axis=0)
    f = np.fft.rfftfreq(n, 1.0 / rate_hz)
    band = (f >= BAND_HZ[0]) & (f <= BAND_HZ[1])
    most = int(np.ceil(0.1 / SPEED_M_S * rate_hz * INTERP)) + 1
    delays, peaks = [], []
    for i, j in PAIRS:
        cross = spectra[:, j] * np.conj(spectra[:, i])
        cross /= np.abs(cross) + 1e-15
        cross[~band] = 0.0
        correlation = np.fft.irfft(cross, INTERP * n) * INTERP * n / (2 * band.sum())
        near = np.concatenate([correlation[-most:], correlation[: most + 1]])
        best = int(np.argmax(near))
        delays.append((best - most) / (INTERP * rate_hz))
        peaks.append(near[best])
    return np.array(delays), np.array(peaks)


def main():
    path, address = sys.argv[1:]
    link = mavutil.mavlink_connection(address, source_system=1, source_component=191)
    sound = soundfile.SoundFile(path)
    rate_hz = sound.samplerate
    held = np.zeros((0, len(MICS)))
    start, heard, beat = time.monotonic(), 0, 0.0
    while True:
        block = sound.read(HOP, always_2d=True)
        if len(block) < HOP:
            break
        heard += HOP
        end = start + heard / rate_hz
        time.sleep(max(0.0, end - time.monotonic()))  # a microphone gives a block when it is full
        held = np.concatenate([held, block])[-FRAME:]
        if len(held) == FRAME:
            delays, peaks = gcc_phat(held, rate_hz)
            u = np.linalg.lstsq(SLOPE, delays, rcond=None)[0]
            azimuth = np.degrees(np.arctan2(u[1], u[0])) % 360.0
            if peaks.mean() > LEAST_PEAK:
                link.mav.debug_vect_send(b"BEARING", int(end * 1e6), azimuth, peaks.mean(), 0.0)
        if time.monotonic() - beat > 1.0:
            beat = time.monotonic()
            link.mav.heartbeat_send(
                mavutil.mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavutil.mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0
            )


if __name__ == "__main__":
    main()
