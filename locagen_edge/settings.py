"""Settings: nested frozen dataclasses, filled from TOML, refused with every fault at once.

Each field states its own sentence, unit, range or choices beside its default. The reader, the checks and
the sample file (`python -m locagen_edge.settings`, which is systemd/locagen-edge.toml) all come from
that one place, so they cannot disagree.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import textwrap
import tomllib
import types
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge.errors import SettingsError
from locagen_edge.geometry import KELVIN, MicArray, equilateral, quaternion, rotation, speed_of_sound

DEFAULT_PATH = Path("/etc/locagen-edge/locagen-edge.toml")

NAME = r"[a-z0-9][a-z0-9_.-]*"


def setting(
    default: Any,
    text: str,
    *,
    unit: str = "",
    least: float = -math.inf,
    most: float = math.inf,
    choices: tuple[str, ...] = (),
    pattern: str = "",
) -> Any:
    """A dataclass field that carries its own manual entry and limits (both ends allowed)."""
    meta = {
        "text": text,
        "unit": unit,
        "least": least,
        "most": most,
        "choices": choices,
        "pattern": pattern,
    }
    return field(default=default, metadata=meta)


def _triangle() -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(x), 6) + 0.0 for x in row) for row in equilateral().positions_m)


@dataclass(frozen=True)
class ArraySettings:
    """The microphones, as they sit on the frame."""

    positions_m: tuple[tuple[float, ...], ...] = setting(
        _triangle(),
        "One row per microphone, in the order of audio.channel_map: x forward, y right, z down, from any "
        "common origin. The default is an equilateral triangle of 10 cm.",
        unit="m",
        least=-10,
        most=10,
    )
    tolerance_m: float = setting(
        0.0005,
        "How well those positions are known (1-sigma). It goes into every sigma: 1 mm costs about half a "
        "degree on a 10 cm array.",
        unit="m",
        least=0,
        most=0.1,
    )
    delays_s: tuple[float, ...] = setting(
        (),
        "By how much each channel of `alsa` or `wav` is late, one number per microphone; empty: all are in "
        "step. `locagen-edge calibrate` measures it; it is taken out before anything else hears the sound.",
        unit="s",
        least=-0.005,
        most=0.005,
    )
    gains_db: tuple[float, ...] = setting(
        (),
        "By how much each channel of `alsa` or `wav` is too loud, one number per microphone; empty: all are "
        "alike. Measured and taken out in the same way.",
        unit="dB",
        least=-40,
        most=40,
    )
    mount_deg: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        "How the axes of array.positions_m are turned against the vehicle's: roll, pitch, yaw, as of a "
        "vehicle that flies (yaw clockwise first, then pitch nose up, then roll right side down).",
        unit="degrees",
        least=-180,
        most=180,
    )


@dataclass(frozen=True)
class EnvironmentSettings:
    """The air between caller and microphones."""

    temperature_c: float = setting(
        20.0,
        "Air temperature; the speed of sound follows from it.",
        unit="degrees Celsius",
        least=-60,
        most=60,
    )


@dataclass(frozen=True)
class AudioSettings:
    """Where sound comes from, and how it is cut into frames."""

    source: str = setting(
        "sim",
        "`alsa` for microphones, `wav` for a recording, `sim` for a synthetic drone scene.",
        choices=("alsa", "wav", "sim"),
    )
    device: str = setting(
        "",
        "ALSA: the device's name, or a part of it, as `locagen-edge devices` prints it; or `hw:CARD=ID`, "
        "which it prints too, and which stays whatever number the card is given. Empty: the default.",
    )
    device_rate_hz: int = setting(
        48000, "ALSA: the rate asked of the device.", unit="Hz", least=8000, most=192000
    )
    device_channels: int = setting(
        3, "ALSA: how many channels the device is opened with.", unit="channels", least=1, most=64
    )
    sample_format: str = setting(
        "int16",
        "ALSA: how the device delivers samples; `int24` for converters of 24 or 32 bits.",
        choices=("int16", "int24", "float32"),
    )
    channel_map: tuple[int, ...] = setting(
        (0, 1, 2),
        "Which channel of the device or file is which row of array.positions_m, counted from 0.",
        least=0,
        most=63,
    )
    file: str = setting("", "WAV: the recording (WAV, FLAC, any rate; channels by channel_map).")
    loop: bool = setting(False, "WAV: begin again at the end instead of stopping.")
    rate_hz: int = setting(
        10000, "The processing rate; every source is resampled to it.", unit="Hz", least=4000, most=96000
    )
    frame: int = setting(1024, "Samples in a frame: a power of two.", unit="samples", least=256, most=4096)
    hop: int = setting(
        512, "Samples from one frame to the next; at most a frame.", unit="samples", least=32, most=4096
    )


@dataclass(frozen=True)
class SimSettings:
    """The synthetic scene: a caller that circles a hovering drone, heard under four rotors."""

    call: str = setting(
        "scream",
        "What calls.",
        choices=("white", "speech", "scream", "whistle", "tone", "knock", "instrument"),
    )
    azimuth_deg: float = setting(
        40.0, "Where the caller starts, clockwise from ahead.", unit="degrees", least=-360, most=360
    )
    turn_deg_s: float = setting(
        6.0, "How fast the caller goes round, clockwise.", unit="degrees/s", least=-180, most=180
    )
    distance_m: float = setting(30.0, "Horizontal distance of the caller.", unit="m", least=0.5, most=1000)
    height_m: float = setting(15.0, "Height of the array above the caller.", unit="m", least=0, most=1000)
    call_s: float = setting(1.5, "Length of one call.", unit="s", least=0.05, most=3600)
    pause_s: float = setting(
        0.7, "Silence between two calls; 0: it never stops.", unit="s", least=0, most=3600
    )
    snr_db: float = setting(
        5.0, "In-band level of the call over rotors and sensor noise together.", unit="dB", least=-60, most=80
    )
    rotors: int = setting(4, "Number of rotors; 0: sensor noise alone.", unit="rotors", least=0, most=8)
    rotor_arm_m: float = setting(
        0.30, "Distance of each rotor's hub from the origin.", unit="m", least=0.05, most=5
    )
    throttle: float = setting(0.5, "Mean throttle; the blade rate follows it.", least=0, most=1)
    noise_dbfs: float = setting(
        -35.0,
        "In-band level of rotors and sensor noise at each microphone.",
        unit="dBFS",
        least=-120,
        most=-3,
    )
    sensor_db: float = setting(
        -10.0,
        "Sensor noise, independent in each microphone, relative to the rotors.",
        unit="dB",
        least=-80,
        most=40,
    )
    seed: int = setting(1, "Same seed, same sound.", least=0, most=2**31 - 1)


@dataclass(frozen=True)
class DenoiseSettings:
    """Taking the rotors out of the sound, by networks that know them."""

    kind: str = setting(
        "none",
        "`wave`: every microphone's sound goes through the paper's network before it is correlated, and "
        "comes 6 ms later. `mask`: the sound stays as it is, and a network says which frequencies are the "
        'caller\'s, for bearing.estimator = "steered".',
        choices=("none", "wave", "mask"),
    )
    wave: str = setting("denoise-wave", "The model of `wave`.", pattern=NAME)
    mask: str = setting(
        "denoise-mask",
        "The model of `mask`; `locagen-lab denoise tune` makes one for your drone.",
        pattern=NAME,
    )
    forget_s: float = setting(
        4.0,
        "How fast the spectrum of the noise is learnt and forgotten, while nothing calls.",
        unit="s",
        least=0.2,
        most=600,
    )


@dataclass(frozen=True)
class CorrelationSettings:
    """GCC-PHAT of all pairs."""

    band_hz: tuple[float, ...] = setting(
        (300.0, 4700.0), "Lowest and highest frequency used.", unit="Hz", least=1, most=48000
    )
    oversample: int = setting(
        16, "Grid points per sample of lag; a parabola refines further.", unit="points", least=4, most=64
    )
    floor_dbfs: float = setting(
        -120.0,
        "Power of one frequency bin below which it fades out: silence gives zeros, not noise.",
        unit="dBFS",
        least=-200,
        most=-1,
    )
    relative_floor_db: float = setting(
        -20.0,
        "The same, relative to the mean bin of the frame: bins that the sound leaves empty do not count.",
        unit="dB",
        least=-120,
        most=-1,
    )


@dataclass(frozen=True)
class BearingSettings:
    """From delays to a direction."""

    estimator: str = setting(
        "steered",
        "`steered`: greatest likelihood over directions, with the noise's own matrix divided out. "
        "`far-field`: least squares over the delays of all pairs. `hyperbolic`: the paper's solver, with a "
        "position. `two-mic`: arcsin of the first pair alone. `model:NAME`: a learned one from the models "
        "directory.",
        pattern=rf"far-field|hyperbolic|two-mic|steered|model:{NAME}",
    )


@dataclass(frozen=True)
class SteeredSettings:
    """The estimator `steered`, the default."""

    taper: float = setting(
        0.1,
        "Share of the window that is tapered. 0.1 wastes least of the sound; 1 (Hann) keeps strong rotor "
        "tones from spreading over their neighbours.",
        least=0,
        most=1,
    )
    smooth_bins: int = setting(
        6,
        "Bins to each side over which a caller's spectrum is taken for smooth.",
        unit="bins",
        least=0,
        most=64,
    )
    span_s: float = setting(
        0.8,
        "Time constant of the average that finds callers too faint for one frame. Longer hears further, and "
        "lags on a drone that turns.",
        unit="s",
        least=0.1,
        most=10,
    )
    smear: float = setting(
        0.03,
        "Share of the noise's matrix, averaged over 100 Hz to each side, that is added to it: more bears "
        "rotors whose tones wander, less hears between tones that keep still.",
        least=0,
        most=1,
    )
    weigh: bool = setting(
        True,
        "Callers are placed by those frequencies at which they stand out of the noise; whether something "
        "calls is decided by all alike. Off: placed by all alike, which is less often right at -10 dB.",
    )
    forget_s: float = setting(
        4.0,
        "How fast the noise's matrix is learnt and forgotten, while nothing calls: shorter follows the "
        "throttle, longer is more exact.",
        unit="s",
        least=0.2,
        most=600,
    )


@dataclass(frozen=True)
class DetectionSettings:
    """When a sound counts as a call."""

    evidence: float = setting(
        5.0,
        "Estimator `steered`: how many times what noise alone scores a direction has to score to be a call. "
        "5 gives no false call in an hour of rotors that hover, nor in one of rotors that hunt; 4 hears "
        "further.",
        unit="times", least=1, most=1000,
    )  # fmt: skip
    repeats_s: float = setting(
        40.0,
        "Estimator `steered`: for how long what is too faint for a call is remembered, so that somebody who "
        "calls again and again from one direction is found (and somebody who was found once, sooner). 0: not "
        "at all.",
        unit="s",
        least=0,
        most=600,
    )
    snr_db: float = setting(
        0.0, "Other estimators: in-band level over the tracked background from which a frame is a call.",
        unit="dB", least=-20, most=60,
    )  # fmt: skip
    misfit: float = setting(
        6.0, "Other estimators: largest misfit of the delays with one far source.",
        unit="sigma", least=1, most=1000,
    )  # fmt: skip
    background_s: float = setting(
        6.0,
        "Time whose quietest moment is the background: a level that lasts longer, rotors or a call, is it.",
        unit="s",
        least=0.5,
        most=600,
    )


@dataclass(frozen=True)
class TrackSettings:
    """Bearings over time."""

    agility_deg_s2: float = setting(
        10.0,
        "How briskly the drone changes its rate of turn, per square root of a second. Counts where its "
        "attitude is not known, and bearings are followed as the body sees them. Less is smoother and lags "
        "more.",
        unit="degrees/s2",
        least=0.1,
        most=1000,
    )
    agility_earth_deg_s2: float = setting(
        2.0,
        "The same where the attitude is known, and only flying past a caller changes a bearing: 2 is for "
        "10 m/s past a caller 30 m away.",
        unit="degrees/s2",
        least=0.1,
        most=1000,
    )
    coast_s: float = setting(
        2.0, "How long a track lives on after the last call.", unit="s", least=0.1, most=600
    )
    most: int = setting(
        4, "Callers followed at a time; beyond that the weakest gives way.", unit="callers", least=1, most=8
    )


@dataclass(frozen=True)
class PoseSettings:
    """Attitude, position and height of the vehicle, as its autopilot tells them."""

    rate_hz: float = setting(
        20.0,
        "How often the attitude is asked for (position and heights less often); 0: nothing is asked for, and "
        "what comes anyway is used.",
        unit="Hz", least=0, most=100,
    )  # fmt: skip
    attitude_limit_s: float = setting(
        0.25,
        "Longest time from a message to the sound that takes its attitude from it. Between two messages it "
        "is interpolated, after the last it goes on at their rate; what is older counts as not known.",
        unit="s", least=0.01, most=5,
    )  # fmt: skip
    position_limit_s: float = setting(
        1.0, "The same for position and heights.", unit="s", least=0.01, most=60
    )
    compass_deg: float = setting(
        3.0,
        "1-sigma of the true heading, magnetic declination included. It goes into azimuths from true north "
        "(those from the nose keep the smaller sigma), and into positions: no average takes it away.",
        unit="degrees", least=0, most=90,
    )  # fmt: skip
    tilt_deg: float = setting(
        1.0, "The same of roll and pitch, mounting included.", unit="degrees", least=0, most=90
    )
    relief_m: float = setting(
        15.0,
        "1-sigma of the ground's height against that of the take-off place. Counts where neither "
        "rangefinder nor terrain data tell the height over ground.",
        unit="m", least=0, most=5000,
    )  # fmt: skip


@dataclass(frozen=True)
class PositionSettings:
    """From bearings along the flight to a place on the map."""

    vehicle: str = setting(
        "",
        "This vehicle's name in the sightings of the log, which `fuse` joins with those of others; empty: "
        "the computer's name, which has to be another on each vehicle.",
    )
    range_m: tuple[float, ...] = setting(
        (2.0, 1000.0),
        "Least and greatest horizontal distance at which a caller may be; every doubling between them is as "
        "likely as any other. The second well beyond what can be heard: a caller near it has no position.",
        unit="m",
        least=0.5,
        most=20000,
    )
    look_s: float = setting(
        0.2,
        "Looks of one vehicle at one caller that follow sooner are left out: their noise is the last one's.",
        unit="s",
        least=0,
        most=60,
    )
    gps_m: float = setting(
        1.5, "1-sigma of the vehicle's place, per axis; it goes into the caller's whole.",
        unit="m", least=0, most=1000,
    )  # fmt: skip
    bias_s: float = setting(
        300.0,
        "How long an error of compass, attitude, GPS and height lasts before it is another.",
        unit="s",
        least=1,
        most=1e6,
    )
    terrain_m: float = setting(
        1.0,
        "1-sigma of the ground's height (or of the floor) at the caller against that below the vehicle.",
        unit="m",
        least=0,
        most=1000,
    )
    terrain_share: float = setting(
        0.03, "The same, per metre of distance: 0.03 is 3 m at 100 m. Hills need more.", least=0, most=1
    )
    walk_m: float = setting(
        0.1,
        "How far a caller strays, per square root of a second: 0.1 is 0.8 m in a minute, 1 is 8 m.",
        unit="m/s^0.5",
        least=0,
        most=100,
    )
    gate_sigma: float = setting(
        4.0, "Looks further off than this count as another sound.", unit="sigma", least=2, most=100
    )
    told_share: float = setting(
        0.3,
        "A place is told where the ellipse's longer semi-axis (1-sigma) is at most this share of the "
        "distance, or 10 m; else the range counts as not observable.",
        least=0.01,
        most=1,
    )
    forget_s: float = setting(
        120.0, "A place is kept for so long after the last look.", unit="s", least=1, most=1e5
    )
    callers: int = setting(
        8, "Callers followed at once; beyond that the longest unheard is forgotten.", least=1, most=1000
    )


@dataclass(frozen=True)
class ModelsSettings:
    """ONNX models."""

    directory: str = setting(
        "", "Where manifest.json and the models lie; empty: those that came with the program."
    )


@dataclass(frozen=True)
class MavlinkSettings:
    """The link to the flight controller or ground station."""

    link: tuple[str, ...] = setting(
        ("udpout:127.0.0.1:14550",),
        "One link, or a list of several: `udpout:HOST:PORT` sends there, `udpin:HOST:PORT` listens, "
        "`tcp:HOST:PORT` connects, `tcpin:HOST:PORT` lets one connect, `serial:DEVICE:BAUD` opens a UART. "
        "What is said goes to all of them; nothing is passed on from one to another.",
        pattern=r"(udpout|udpin|tcp|tcpin):[^:\s]+:\d{1,5}|serial:\S+:\d{3,8}",
    )
    system_id: int = setting(
        0,
        "The vehicle's system id; 0: learnt from the autopilot's heartbeat (1 until then).",
        least=0,
        most=254,
    )
    component_id: int = setting(
        191, "Our component id: 191 to 194 are for onboard computers.", least=191, most=194
    )
    rate_hz: float = setting(
        2.0, "How often a bearing is sent while something calls.", unit="Hz", least=0.1, most=20
    )
    signing_key: str = setting(
        "",
        "A file with the key for MAVLink 2 signing, which only its owner may read (chmod 600): 64 "
        "hexadecimal digits, or the passphrase that was given to the ground station. Empty: nothing is "
        "signed. With a key, what comes unsigned or wrongly signed is not obeyed.",
    )
    signing_link_id: int = setting(
        0, "Link id in signatures of the first link; the others count on from it.", least=0, most=255
    )
    state_directory: str = setting(
        "",
        "Folder where what was set over MAVLink (parameters.toml) and signing's last timestamp are kept over "
        "restarts; empty: the service's state directory, /var/lib/locagen-edge (for `run` and `check` by "
        "hand too, with the installed settings), else ~/.local/state/locagen-edge.",
    )
    send_records: bool = setting(
        True, "LOCAGEN_BEARING and LOCAGEN_POSITION: the whole record at once, for programs that know them."
    )
    send_tunnel: bool = setting(
        True, "The same records inside TUNNEL, for paths that drop messages they do not know."
    )
    send_adsb: bool = setting(
        False,
        "A caller's position as ADSB_VEHICLE, which every ground station draws on its map. With an "
        "autopilot that avoids traffic (ArduPilot's ADSB_TYPE above 0) it acts on flight: leave it off.",
    )
    send_camera_target: bool = setting(
        False, "A caller's position as CAMERA_TRACKING_GEO_STATUS, as of a camera that tracks it."
    )
    send_computer_status: bool = setting(
        False, "ONBOARD_COMPUTER_STATUS, every 2 s: load, memory, temperature, disk."
    )


@dataclass(frozen=True)
class FlightSettings:
    """What may act on flight. All of it is off, and only this file can switch it on: no parameter does."""

    roi: bool = setting(
        False, "Point camera or nose at a caller's position: MAV_CMD_DO_SET_ROI_LOCATION, in `flight.modes`."
    )
    yaw: bool = setting(False, "Turn the nose towards a caller: MAV_CMD_CONDITION_YAW, in `flight.modes`.")
    modes: tuple[str, ...] = setting(
        ("GUIDED",),
        "Flight modes, by ArduCopter's names (GUIDED, AUTO, LOITER, ...) or PX4's (HOLD, MISSION), in which "
        "either may be sent. MAV_CMD_CONDITION_YAW goes to ArduCopter alone.",
        choices=("GUIDED", "AUTO", "LOITER", "POSHOLD", "HOLD", "MISSION"),
    )
    every_s: float = setting(10.0, "Least time between two such commands.", unit="s", least=2, most=3600)
    turn_deg: float = setting(
        15.0,
        "A command is repeated only where the bearing has moved by so much.",
        unit="degrees",
        least=1,
        most=180,
    )
    sigma_deg: float = setting(
        10.0, "Largest 1-sigma of a true azimuth that is turned to.", unit="degrees", least=0.1, most=60
    )


@dataclass(frozen=True)
class DaemonSettings:
    """The service itself."""

    queue_frames: int = setting(
        8,
        "Frames that may wait for the pipeline; beyond that the oldest is dropped and counted.",
        unit="frames", least=1, most=1000,
    )  # fmt: skip
    stall_s: float = setting(
        2.0,
        "Without a frame for this long the source counts as lost: it is reopened, and no heartbeat is sent. "
        "At least two hops.",
        unit="s", least=0.2, most=10,
    )  # fmt: skip
    backoff_s: float = setting(
        1.0,
        "Longest wait between two attempts to reopen a source: with it a device that is plugged in again is "
        "found within 2 s. A link waits for 0.9 s at most.",
        unit="s",
        least=0.1,
        most=600,
    )


@dataclass(frozen=True)
class RecordSettings:
    """`locagen-edge record`: all channels of the source as they come, in parts, on disk."""

    directory: str = setting("recordings", "Where the parts go; --output comes before it.")
    part_s: float = setting(600.0, "Longest part.", unit="s", least=0.1, most=86400)
    part_mb: float = setting(
        1000.0, "Largest part; three channels of 16 bit at 48 kHz fill 17 MB a minute.",
        unit="MB", least=0.01, most=4000,
    )  # fmt: skip
    total_mb: float = setting(
        16000.0,
        "All parts in the folder together, at least two of the largest; what other programs keep there does "
        "not count.",
        unit="MB",
        least=0.1,
        most=1e8,
    )
    free_mb: float = setting(
        500.0, "What has to stay free on the disk, for whoever else writes there.",
        unit="MB", least=0, most=1e8,
    )  # fmt: skip
    when_full: str = setting(
        "stop",
        "At either bound: `stop`, or give up the `oldest` parts of the folder for new ones.",
        choices=("stop", "oldest"),
    )
    sync_s: float = setting(
        2.0, "What a loss of power costs at most: so often all is forced to the disk.",
        unit="s", least=0.1, most=60,
    )  # fmt: skip


@dataclass(frozen=True)
class LogSettings:
    """The black box of `locagen-edge run`: bearings and events, and on request the sound of each call."""

    directory: str = setting(
        "",
        "Where it is kept; empty: the service's state directory, /var/lib/locagen-edge under systemd, and "
        "nowhere when `run` is started by hand.",
    )
    total_mb: float = setting(
        200.0, "All of the log; the oldest part is deleted for a new one. An hour of calls fills 50 MB.",
        unit="MB", least=0.01, most=1e6,
    )  # fmt: skip
    part_mb: float = setting(10.0, "One part.", unit="MB", least=0.001, most=1000)
    sync_s: float = setting(
        2.0, "What a loss of power costs at most, of bearings; events are on the disk within 0.3 s.",
        unit="s", least=0.1, most=60,
    )  # fmt: skip
    snippets: bool = setting(
        False, "Whether the sound of each confirmed call is kept too, as FLAC that `replay` reads."
    )
    before_s: float = setting(
        3.0, "A snippet begins so long before the call was confirmed.", unit="s", least=0, most=30
    )
    after_s: float = setting(
        1.0, "A snippet ends so long after the track of the call has ended.", unit="s", least=0, most=60
    )
    longest_s: float = setting(60.0, "A snippet ends here at the latest.", unit="s", least=0.5, most=3600)
    snippets_mb: float = setting(
        500.0, "All snippets; the oldest is deleted for a new one. Three microphones fill 4.5 MB a minute.",
        unit="MB", least=0.01, most=1e6,
    )  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """All settings. Every section and every key may be left out."""

    array: ArraySettings = ArraySettings()
    environment: EnvironmentSettings = EnvironmentSettings()
    audio: AudioSettings = AudioSettings()
    sim: SimSettings = SimSettings()
    denoise: DenoiseSettings = DenoiseSettings()
    correlation: CorrelationSettings = CorrelationSettings()
    bearing: BearingSettings = BearingSettings()
    steered: SteeredSettings = SteeredSettings()
    detection: DetectionSettings = DetectionSettings()
    track: TrackSettings = TrackSettings()
    pose: PoseSettings = PoseSettings()
    position: PositionSettings = PositionSettings()
    models: ModelsSettings = ModelsSettings()
    mavlink: MavlinkSettings = MavlinkSettings()
    flight: FlightSettings = FlightSettings()
    daemon: DaemonSettings = DaemonSettings()
    record: RecordSettings = RecordSettings()
    log: LogSettings = LogSettings()

    def __post_init__(self) -> None:
        faults = [*_faults_of_fields(self), *_faults_between_fields(self)]
        if faults:
            raise SettingsError("\n".join(faults))

    @cached_property
    def mic_array(self) -> MicArray:
        """The microphones in the vehicle's body axes: `array.positions_m` turned by `array.mount_deg`."""
        return _mounted(self.array)

    @property
    def speed_m_s(self) -> float:
        return speed_of_sound(self.environment.temperature_c)

    @property
    def hop_s(self) -> float:
        return self.audio.hop / self.audio.rate_hz


def _mounted(array: ArraySettings) -> MicArray:
    positions_m = np.array(array.positions_m, dtype=np.float64)
    if not any(array.mount_deg):
        return MicArray(positions_m)
    roll, pitch, yaw = map(math.radians, array.mount_deg)
    return MicArray(positions_m @ rotation(quaternion(roll, pitch, yaw)).T)


# --- the checks ---------------------------------------------------------------------------------------


def _sections(settings: Settings) -> Iterator[tuple[str, Any]]:
    for section in dataclasses.fields(settings):
        yield section.name, getattr(settings, section.name)


def _faults_of_fields(settings: Settings) -> Iterator[str]:
    for name, section in _sections(settings):
        for key in dataclasses.fields(section):
            for fault in _faults_of_value(getattr(section, key.name), key.metadata):
                yield f"{name}.{key.name}: {fault}"


def _faults_of_value(value: Any, meta: Any) -> Iterator[str]:
    if isinstance(value, tuple):
        seen: set[str] = set()
        for item in value:
            seen.update(_faults_of_value(item, meta))
        yield from sorted(seen)
    elif isinstance(value, str):
        if meta["choices"] and value not in meta["choices"]:
            yield f"{value!r} is none of {', '.join(meta['choices'])}"
        elif meta["pattern"] and not re.fullmatch(meta["pattern"], value):
            yield f"{value!r} is not of the form that the manual gives: {meta['text']}"
    elif not isinstance(value, bool):
        unit = f" {meta['unit']}" if meta["unit"] else ""
        if isinstance(value, float) and not math.isfinite(value):
            yield f"{value} is not a finite number"
        elif not meta["least"] <= value <= meta["most"]:
            yield f"{value}{unit} is outside {meta['least']:g} to {meta['most']:g}{unit}"


def _faults_between_fields(s: Settings) -> Iterator[str]:
    yield from _faults_of_array(s)
    yield from _faults_of_link(s)
    snippet_mb = (s.log.longest_s + 1.0) * s.audio.rate_hz * (max(s.audio.channel_map, default=0) + 1) * 4e-6
    if s.log.snippets and s.log.snippets_mb < snippet_mb + 0.1:
        yield (
            f"log.snippets_mb: {s.log.snippets_mb:g} MB is less than one snippet of log.longest_s "
            f"({snippet_mb + 0.1:.1f} MB)"
        )
    for name, section in (("record", s.record), ("log", s.log)):
        if 2 * section.part_mb > section.total_mb:  # the part being written, and one to give up for it
            yield f"{name}.total_mb: {section.total_mb:g} MB is less than two parts ({name}.part_mb)"
    if len(s.position.range_m) != 2 or not 1.5 * s.position.range_m[0] < s.position.range_m[1]:
        yield f"position.range_m: {list(s.position.range_m)} is not a least and a greatest distance"
    if s.audio.rate_hz > 0 and s.daemon.stall_s < 2 * s.hop_s:
        yield f"daemon.stall_s: {s.daemon.stall_s:g} s is less than two hops ({2 * s.hop_s:.3g} s)"
    if s.audio.frame & (s.audio.frame - 1):
        yield f"audio.frame: {s.audio.frame} is not a power of two"
    if s.audio.hop > s.audio.frame:
        yield f"audio.hop: {s.audio.hop} is longer than audio.frame ({s.audio.frame})"
    if len(set(s.audio.channel_map)) != len(s.audio.channel_map):
        yield f"audio.channel_map: {list(s.audio.channel_map)} names a channel twice"
    if len(s.audio.channel_map) != len(s.array.positions_m):
        yield (
            f"audio.channel_map: {len(s.audio.channel_map)} channels, "
            f"but array.positions_m has {len(s.array.positions_m)} microphones"
        )
    yield from _faults_of_denoiser(s)
    if s.audio.source == "alsa" and max(s.audio.channel_map, default=0) >= s.audio.device_channels:
        yield (
            f"audio.channel_map: names channel {max(s.audio.channel_map)}, "
            f"but audio.device_channels is {s.audio.device_channels} (counted from 0)"
        )
    if s.audio.source == "wav" and not s.audio.file:
        yield "audio.file: is empty, but audio.source is wav"
    band = s.correlation.band_hz
    if len(band) != 2 or not band[0] < band[1]:
        yield f"correlation.band_hz: {list(band)} is not a lowest and a highest frequency"
    elif np.float32(band[1]) >= s.audio.rate_hz / 2:  # the kernel's precision
        yield f"correlation.band_hz: {band[1]:g} Hz is not below half of audio.rate_hz ({s.audio.rate_hz} Hz)"
    elif (band[1] - band[0]) * s.audio.frame / s.audio.rate_hz < 8:
        bin_hz = s.audio.rate_hz / s.audio.frame
        yield f"correlation.band_hz: {list(band)} holds fewer than 8 bins of {bin_hz:.3g} Hz"


def _faults_of_array(s: Settings) -> Iterator[str]:
    key = "array.positions_m"
    positions = s.array.positions_m
    if any(len(row) != 3 for row in positions):
        yield f"{key}: every row needs three numbers, x forward, y right, z down"
        return
    if not 2 <= len(positions) <= 8:
        yield f"{key}: {len(positions)} microphones; 2 to 8 are possible"
        return
    if not all(math.isfinite(x) for row in positions for x in row):
        return
    for name in ("delays_s", "gains_db"):
        values = getattr(s.array, name)
        if values and len(values) != len(positions):
            yield f"array.{name}: {len(values)} numbers for {len(positions)} microphones; one each, or none"
    if len(s.array.mount_deg) != 3:
        yield f"array.mount_deg: {list(s.array.mount_deg)} is not roll, pitch, yaw"
        return
    if not all(math.isfinite(x) for x in s.array.mount_deg):
        return
    array = _mounted(s.array)
    for (i, j), spacing in zip(array.pairs, array.spacing_m, strict=True):
        if spacing < 1e-3:
            yield f"{key}: microphones {i} and {j} are at the same place"
    if s.environment.temperature_c > -KELVIN:
        longest = array.longest_delay_s(s.speed_m_s) * s.audio.rate_hz
        if longest + 2 >= s.audio.frame / 4:  # room for the margin and the parabola's neighbour
            yield f"{key}: a longest delay of {longest:.0f} samples is too much for frames of {s.audio.frame}"
    flat = array.baselines_m[:, :2]
    if s.bearing.estimator == "two-mic":
        if np.hypot(*flat[0]) < 1e-3:
            yield f"{key}: the first two stand one above the other: they see no azimuth"
    elif np.linalg.matrix_rank(flat, tol=1e-3) < 2:
        yield (
            f"{key}: seen from above the microphones are on one line, "
            f"and bearing.estimator = {s.bearing.estimator!r} needs a plane"
        )


def _faults_of_denoiser(s: Settings) -> Iterator[str]:
    """A mask weighs spectra; the networks know one rate, and take the sound by 512 samples."""
    if s.denoise.kind == "mask" and s.bearing.estimator != "steered":
        yield (
            f"denoise.kind: {s.denoise.kind!r} needs bearing.estimator = 'steered': "
            f"{s.bearing.estimator!r} has no use for a mask"
        )
    if s.denoise.kind == "none":
        return
    if s.audio.rate_hz != 10000:
        yield f"denoise.kind: {s.denoise.kind!r} needs audio.rate_hz = 10000, not {s.audio.rate_hz}"
    if s.audio.hop % 512 or s.audio.frame % 512:
        yield (
            f"denoise.kind: {s.denoise.kind!r} needs audio.hop and audio.frame to be multiples of 512, "
            f"not {s.audio.hop} and {s.audio.frame}"
        )


def _faults_of_link(s: Settings) -> Iterator[str]:
    links = s.mavlink.link
    if not 1 <= len(links) <= 8:
        yield f"mavlink.link: {len(links)} links; 1 to 8 are possible"
    for twice in sorted({link for link in links if links.count(link) > 1}):
        yield f"mavlink.link: {twice!r} is there twice"
    for link in links:
        scheme, _, rest = link.partition(":")
        digits = rest.rpartition(":")[2]
        what, most = ("baud rate", 10_000_000) if scheme == "serial" else ("port", 65535)
        if digits.isdigit() and not 1 <= int(digits) <= most:
            yield f"mavlink.link: {what} {digits} is not a number from 1 to {most}"


RENAMED = {"mavlink.signing_state": "mavlink.state_directory"}
"""keys of earlier versions"""

S = typing.TypeVar("S", bound=Settings)

# --- reading ------------------------------------------------------------------------------------------


def load(path: Path | str, kind: type[S] = Settings) -> S:  # type: ignore[assignment]
    """Settings from a TOML file; `kind` may be a subclass that has more sections.

    Raises `SettingsError` with one line per fault, each beginning with `section.key`.
    """
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        table = tomllib.loads(text.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: is not TOML: {error}") from error
    return from_table(table, kind)


def from_table(table: dict[str, Any], kind: type[S] = Settings) -> S:  # type: ignore[assignment]
    """Settings from nested dictionaries as TOML gives them. Raises `SettingsError` like `load`."""
    faults: list[str] = []
    sections: dict[str, Any] = {}
    known = {section.name: section for section in dataclasses.fields(kind)}
    kinds = typing.get_type_hints(kind)
    for name, content in table.items():
        if name not in known:
            faults.append(f"{name}: unknown section; known are {', '.join(known)}")
        elif not isinstance(content, dict):
            faults.append(f"{name}: is a section: write [{name}] and its keys below")
        else:
            sections[name] = _section(kinds[name], name, content, faults)
    try:
        settings = kind(**sections)
    except SettingsError as error:
        faults += str(error).splitlines()
    if faults:
        raise SettingsError("\n".join(faults))
    return settings


def _section(kind: type, name: str, content: dict[str, Any], faults: list[str]) -> Any:
    hints = typing.get_type_hints(kind)
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key not in hints:
            new = RENAMED.get(f"{name}.{key}")
            why = f"is called {new} now" if new else f"unknown key; known are {', '.join(hints)}"
            faults.append(f"{name}.{key}: {why}")
            continue
        try:
            values[key] = _convert(value, hints[key])
        except TypeError:
            faults.append(f"{name}.{key}: {value!r} is not {_in_words(hints[key])}")
    return kind(**values)


def _convert(value: Any, kind: Any) -> Any:
    """TOML's value as the field's type; a whole number serves where a float is asked for."""
    if isinstance(kind, types.GenericAlias) or typing.get_origin(kind) is tuple:
        item = typing.get_args(kind)[0]
        if item is str and isinstance(value, str):
            value = (value,)  # a list of one text may be written without its brackets
        if not isinstance(value, (list, tuple)):
            raise TypeError
        return tuple(_convert(v, item) for v in value)
    if kind is float and type(value) in (int, float):
        try:
            return float(value)
        except OverflowError:  # a whole number of 400 digits
            return math.inf if value > 0 else -math.inf
    if type(value) is not kind:
        raise TypeError
    return value


WORDS: dict[Any, str] = {str: "a text", int: "a whole number", float: "a number", bool: "true or false"}


def _in_words(kind: Any) -> str:
    if kind in WORDS:
        return WORDS[kind]
    return f"a list, each item {_in_words(typing.get_args(kind)[0])}"


# --- the sample file ----------------------------------------------------------------------------------


def sample(settings: Settings | None = None, origin: str = "What stands here are the defaults.") -> str:
    """The sample file: every section and key with its sentence, unit, range and value (or default).

    `origin`: where the values come from, in a sentence for the file's head.
    """
    lines = [
        *_wrapped(f"Settings of locagen-edge. Every key may be left out. {origin}"),
        "# Check a changed file with: locagen-edge check --settings FILE",
    ]
    for name, section in _sections(settings or Settings()):
        lines += ["", f"# {(type(section).__doc__ or '').strip()}", f"[{name}]"]
        for key in dataclasses.fields(section):
            lines += _wrapped(key.metadata["text"] + _limits(key.metadata))
            lines.append(f"{key.name} = {_toml(getattr(section, key.name))}")
    return "\n".join(lines) + "\n"


def _limits(meta: Any) -> str:
    parts = [meta["unit"]] if meta["unit"] else []
    if math.isfinite(meta["least"]):
        parts.append(f"{meta['least']:.10g} to {meta['most']:.10g}")
    if meta["choices"]:
        parts.append(" | ".join(meta["choices"]))
    return f" ({', '.join(parts)})" if parts else ""


def _wrapped(text: str, width: int = 108) -> list[str]:
    return textwrap.wrap(text, width, initial_indent="# ", subsequent_indent="# ")


def _toml(value: Any) -> str:
    if isinstance(value, tuple) and value and isinstance(value[0], tuple):
        return "[\n" + "".join(f"    {_toml(row)},\n" for row in value) + "]"
    formats: dict[type, Callable[[Any], str]] = {
        bool: lambda v: "true" if v else "false",
        str: lambda v: json.dumps(v, ensure_ascii=False).replace("\x7f", "\\u007f"),  # JSON lets DEL stand
        tuple: lambda v: "[" + ", ".join(_toml(item) for item in v) + "]",
    }
    return formats.get(type(value), repr)(value)


if __name__ == "__main__":
    print(sample(), end="")
