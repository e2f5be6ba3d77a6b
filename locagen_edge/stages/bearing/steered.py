"""The direction of greatest likelihood, from the spectra themselves and whitened by the noise's own matrix.

Delays throw away what does not fit into one number a pair; the search over directions keeps it. In plain
noise it comes close to the Cramer-Rao bound, and it hears under rotors, which are loud but always come from
the same places: the noise's cross-spectral matrix is learnt while nothing calls, held while something does,
and divided out. The mathematics and its sources: `csrc/locagen.h`.

Two averages of the signal are searched side by side, one frame and about a second. A loud caller is placed by
the frame, anew each time; one too faint for that by the second, with what that takes from a drone that turns.

Whether something calls is decided by all bins alike. Where it does, it is placed by another search, in which
each bin counts by the square of Wiener's gain, which is what that leaves of its power: noise that comes from
elsewhere than it did, and is no louder, says nothing then. At -10 dB that is right more often
(`docs/denoise.md`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from locagen_edge.geometry import NOWHERE_RAD, tolerance_rad
from locagen_edge.kernel import Source, Steered
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import LARGEST_AZIMUTH_SIGMA_RAD, no_bearing
from locagen_edge.stages.bearing.evidence import Onsets, Usual
from locagen_edge.types import F32, Bearing, Evidence, Frame, Mask, Tdoa

NAME = "steered"

DEAD = 1e-5
"""Of the loudest microphone's power: what the kernel takes for a dead one."""

LOOKS = 5
"""Frames of noise per microphone before the first bearing (0.8 s for three at the default hop): a matrix
learnt from fewer is nearly singular, and whitening by it invents sources."""

LAG_S = 0.5
"""Noise is learnt so late: by then a call is known as one, and its beginning is not learnt. At the start it
is learnt at once, for before the first bearing nothing can be known as a call."""
MEANING = 1.3
"""Evidence from which a direction means something, though not yet a call."""
WATCH_S = 15.0
LOUDER = -0.5
"""Contrast over score below which all of the noise has become louder: about -2 where it has, 0 for a call."""
LONGEST_S = 6.0
"""Nobody calls for longer without a breath: rotors that have started, or another kind of noise."""
PAUSE_S = 0.3
"""From a loud caller's last sound on he counts as silent: longer than the pauses between syllables."""
FLAT = 0.93
"""Least score over the best from which all directions are alike: noise far louder than what was learnt."""
SILENCE = 1e-11
"""-110 dBFS mean square in the band: a muted input teaches nothing."""
RIVAL = 0.97
"""Score of another lobe over the best from which nobody knows which is true, however loud the caller: the
microphones stand where they should to within their tolerance only."""
CLOSER = 2.5
"""Roots of the score by which the best lobe has to be ahead of any other: chance gives as much. A whistle of
3 kHz, whose wavelength is shorter than twice the array, has lobes that are nearly alike; a voice has one."""
SECOND = 0.2
"""Least score of a second caller beside the first one's, who has to be a call by himself too: below it lies
what a null leaves of the first."""


class SteeredLocator:
    """Searches every frame, and learns the noise from those that held no call. One per stream."""

    def __init__(self, settings: Settings):
        steered, audio = settings.steered, settings.audio
        self._hop_s = hop_s = settings.hop_s
        self._lag = min(64, math.ceil(LAG_S / hop_s))
        self.apply(settings)
        self._search = Steered(
            settings.mic_array.positions_m,
            frame=audio.frame,
            hop=audio.hop,
            rate_hz=float(audio.rate_hz),
            speed_m_s=settings.speed_m_s,
            band_hz=(settings.correlation.band_hz[0], settings.correlation.band_hz[1]),
            taper=steered.taper,
            smooth_bins=steered.smooth_bins,
            spans=len(self._spans_s),
            lag=self._lag,
            smear=steered.smear,
            floor=10 ** (settings.correlation.floor_dbfs / 10),
        )
        self._rows, self._columns = len(self._search.elevation_rad), len(self._search.azimuth_rad)
        self._top_rad = float(self._search.elevation_rad[0])
        self._row_rad = self._top_rad - float(self._search.elevation_rad[1])
        first = self._search.first_bin
        self._band = slice(first, first + len(self._search.frequency_hz))
        self._weights: F32 = np.ones((len(self._spans_s), len(self._search.frequency_hz)), dtype=np.float32)
        places_m = settings.mic_array.positions_m - settings.mic_array.positions_m.mean(axis=0)
        self._spread_m2: list[list[float]] = (places_m.T @ places_m).tolist()
        self._tolerance_m = settings.array.tolerance_m
        self._tolerance = tolerance_rad(settings.mic_array, settings.array.tolerance_m)
        self._mics = settings.mic_array.mics
        self._elapsed_s = 0.0
        self._mask: Mask | None = None
        # A microphone that fails for a moment must not be missing from the matrix for long after; one that
        # has failed for good must not keep the others from learning.
        self._bad_hops = 0
        self._know_nothing()

    def _know_nothing(self) -> None:
        """Neither noise nor what has just been heard."""
        self._begin_anew()
        self._onsets = Onsets(self._hop_s)
        self._scores: list[float | None] = [None for _ in self._spans_s]  # the best, where it was looked for
        self._ratios = [0.0 for _ in self._spans_s]  # how those stand out
        self._strange = [False for _ in self._spans_s]
        self._frame_scores: F32 = self._search.map()
        self._strange_hops = 0
        self._loud_hops_ago: int | None = None
        self._to_judge = 0  # the last frames, of which nobody knows yet whether they are noise
        self._failing: deque[bool] = deque(maxlen=self._lag + 1)
        self._silent: deque[bool] = deque(maxlen=self._lag + 1)
        self._quiet_hops = 0
        self._since_lag: deque[float] = deque([0.0], maxlen=self._lag + 1)

    def _begin_anew(self) -> None:
        """Noise of another kind: what was learnt says nothing of it."""
        self._learnt_frames = 0
        self._busy_s = 0.0
        self._to_learn = LOOKS * self._mics
        # an average is worth about half of the hops that it spans: frames overlap
        self._usual = tuple(Usual(max(1.0, 0.5 * span_s / self._hop_s)) for span_s in self._spans_s)

    def apply(self, settings: Settings, /) -> None:
        """Limit and memories as these settings say; what was learnt of the noise stays."""
        self._least_ratio = settings.detection.evidence
        self._weigh = settings.steered.weigh
        self._spans_s = (0.0, settings.steered.span_s)
        self._forget_s = settings.steered.forget_s
        self._patience = settings.steered.forget_s / self._hop_s

    def forget(self) -> None:
        """Begins anew with the noise's matrix."""
        self._search.reset()
        self._know_nothing()

    def __call__(
        self, frame: Frame, _: Tdoa, elapsed_s: float, mask: Mask | None = None, /
    ) -> tuple[Bearing, ...]:
        power, bad_mics = self._search.listen(frame.samples)
        levels = power.tolist()
        loudest = max(levels)
        failing = bad_mics != 0 or min(levels) < DEAD * loudest
        self._bad_hops = self._bad_hops + 1 if failing else 0
        self._failing.append(failing)
        self._silent.append(loudest < SILENCE)
        self._elapsed_s = min(elapsed_s, LAG_S)  # to learn by: what a gap held was not heard
        self._mask = mask
        if elapsed_s > LAG_S:
            self._onsets.forget()
        found = [self._heard(span, elapsed_s) for span in range(len(self._spans_s))]
        if self._to_learn > 0:
            return (no_bearing(NAME),)
        best = self._best(found)
        self._end_of_a_loud_call()
        return best or (no_bearing(NAME, Evidence(min(max(self._ratios), MEANING), 0.0)),)

    def _best(self, found: list[list[Source]]) -> tuple[Bearing, ...]:
        """Of the spans: the frame where that is a call by itself, else whichever stands out more."""
        ratios = self._ratios
        order = sorted(range(len(found)), key=lambda span: -ratios[span])
        if ratios[0] >= self._least_ratio:
            order = [0, *order]
        for span in order:
            # between a loud caller's sounds an average only tells where he was
            if not found[span] or (span > 0 and self._loud_hops_ago is not None):
                continue
            towards = self._nearest(found[span][0])
            # an average over a second remembers what has ended
            if span == 0 or self._onsets.going_on(towards):
                evidence = Evidence(ratios[span], self._onsets.since_s(towards))
                sources = found[span]
                if (self._weigh or self._mask is not None) and ratios[span] >= self._least_ratio:
                    sources = self._placed(sources, span)
                return tuple(self._told(source, span, evidence) for source in sources)
        return ()

    def _end_of_a_loud_call(self) -> None:
        """Who was heard frame by frame and is not any more has stopped: the average begins anew."""
        if self._ratios[0] >= self._least_ratio:
            self._loud_hops_ago = 0
        elif self._loud_hops_ago is not None:
            self._loud_hops_ago += 1
            if self._loud_hops_ago * self._hop_s > PAUSE_S:
                self._loud_hops_ago = None
                for span, span_s in enumerate(self._spans_s):
                    if span_s > 0.0:
                        self._search.hear(1.0, span)

    def _heard(self, span: int, elapsed_s: float) -> list[Source]:
        """The callers in one span; none where the noise alone is as good a reason."""
        span_s = self._spans_s[span]
        share = 1.0 - math.exp(-elapsed_s / span_s) if span_s > 0.0 else 1.0
        self._search.hear(share, span)
        if self._mask is not None:
            weight = np.square(self._mask.weight[self._band])  # a gain's square is what is left of power
            self._weights[span] += np.float32(share) * (weight - self._weights[span])
        self._strange[span] = False
        if span > 0 and self._ratios[0] >= self._least_ratio:
            # the frame places him, and in the average he stands out no less: half of the work is spared
            self._scores[span], self._ratios[span] = None, self._ratios[0]
            return []
        sources = self._sources(span)
        scores: F32 = self._search.map(span)
        if span == 0:
            self._frame_scores = scores
            self._onsets.hear(scores)
        best = float(scores.max())
        if not sources:
            self._note(span, best)
            return []
        first = sources[0]
        if first.contrast < LOUDER * first.score or float(scores.min()) > FLAT * best:
            self._note(span, 0.0)
            self._strange[span] = True
            return []
        self._note(span, max(best, first.score))
        least = max(SECOND * first.score, self._least_ratio * self._usual[span].level)
        return [s for n, s in enumerate(sources) if n == 0 or s.score > least]

    def _note(self, span: int, score: float) -> None:
        self._scores[span], self._ratios[span] = score, self._usual[span].ratio(score)

    def _sources(self, span: int) -> tuple[Source, ...]:
        usual = self._usual[span]
        return self._search.search(2, span, MEANING * usual.known, self._least_ratio * usual.level)

    def _placed(self, found: list[Source], span: int) -> list[Source]:
        """Callers once more, by the bins that are theirs; as they were found where those hold too little.

        Whether something calls has been decided without weights: they can neither make a call nor hide one.
        """
        for weight in self._ways_to_weigh(span):
            self._search.weigh(weight)
            placed = self._sources(span)
            if len(placed) >= len(found) and not _may_be_elsewhere(placed[0]):
                found = list(placed[: len(found)])
                break
        self._search.weigh(np.ones_like(self._weights[span]))
        return found

    def _ways_to_weigh(self, span: int) -> Iterator[F32]:
        """Of all bins, best first: a mask may leave too little where the gain does not."""
        mask = self._weights[span] if self._mask is not None else None
        if self._weigh:
            gain = np.square(self._search.gain(span))
            if mask is not None:
                yield mask * gain
            yield gain
        elif mask is not None:
            yield mask

    def _nearest(self, source: Source) -> int:
        """On the grid."""
        row = round((self._top_rad - source.elevation_rad) / self._row_rad)
        column = round(source.azimuth_rad * self._columns / math.tau) % self._columns
        return min(max(row, 0), self._rows - 1) * self._columns + column

    def _told(self, source: Source, span: int, evidence: Evidence) -> Bearing:
        if _may_be_elsewhere(source):
            return no_bearing(NAME, evidence)
        return self._placed_at(source, span, evidence)

    def _placed_at(self, source: Source, span: int, evidence: Evidence | None) -> Bearing:
        azimuth_sigma, elevation_sigma = source.sigma_rad()
        span_s = self._spans_s[span]
        if evidence is not None and span_s > 0.0:
            # A call that began t ago weighs 1 - exp(-t / span) in the average, and 1 - exp(-2 t / span) among
            # the squares that make the variance: its looks are fewer than if it had gone on all the time.
            fewer = math.sqrt(1.0 + math.exp(-evidence.since_s / span_s))
            azimuth_sigma, elevation_sigma = fewer * azimuth_sigma, fewer * elevation_sigma
        of_azimuth, of_elevation = self._of_positions(source)
        azimuth_sigma = math.hypot(azimuth_sigma, of_azimuth)
        elevation_sigma = math.hypot(elevation_sigma, of_elevation)
        return Bearing(
            azimuth_rad=source.azimuth_rad if azimuth_sigma < LARGEST_AZIMUTH_SIGMA_RAD else None,
            azimuth_sigma_rad=min(azimuth_sigma, NOWHERE_RAD),
            elevation_rad=source.elevation_rad,
            elevation_sigma_rad=min(elevation_sigma, NOWHERE_RAD),
            misfit=0.0,  # the score has judged already whether a source explains the frame
            estimator=NAME,
            evidence=evidence,
            span_s=span_s,
        )

    def _of_positions(self, source: Source) -> tuple[float, float]:
        """1-sigma of azimuth and elevation from positions that are off, radians: least squares over the
        microphones' ways, as in `tolerance_rad`. A flat array sees the elevation through its cosine, which
        hardly changes near the horizon."""
        c, s = math.cos(source.azimuth_rad), math.sin(source.azimuth_rad)
        level, below = math.cos(source.elevation_rad), math.sin(source.elevation_rad)
        # Over the microphones, of the arc towards greater azimuth (-s, c, 0), of the other one
        # (-below c, -below s, -level), and of both. Plain numbers: small arrays cost ten times as much.
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = self._spread_m2
        along = c * c * xx + 2.0 * c * s * xy + s * s * yy
        azimuth = s * s * xx - 2.0 * s * c * xy + c * c * yy
        both = below * (s * c * (xx - yy) - (c * c - s * s) * xy) + level * (s * xz - c * yz)
        elevation = below * below * along + 2.0 * below * level * (c * xz + s * yz) + level * level * zz
        # on the very horizon the second order is left: 1 - cos(error) is what the positions are off by
        elevation += 0.5 * self._tolerance * azimuth
        scale = self._tolerance_m / math.sqrt(max(azimuth * elevation - both * both, 1e-18))
        return scale * math.sqrt(max(elevation, 0.0)) / max(level, 0.1), scale * math.sqrt(max(azimuth, 0.0))

    def likeliest(self, span: int = 0) -> Bearing:
        """The best direction of a span's last frame, however little it stands out: to judge the search by."""
        found = self._search.search(1, span)
        return self._placed_at(found[0], span, None) if found else no_bearing(NAME)

    def frame_scores(self) -> F32:
        """(rows, columns) of the last frame alone, by all bins alike."""
        return self._frame_scores

    def scores(self, bearing: Bearing) -> tuple[F32, F32]:
        """What a bearing of this frame was taken from: azimuths (columns,) and scores (rows, columns)."""
        return self._search.azimuth_rad, self._search.map(self._spans_s.index(bearing.span_s))

    def settle(self, call: bool, /) -> None:
        """Whether the frame was taken for a call: if not, it is noise to learn from, once `LAG_S` has shown
        that no call began in it; so a caller too faint to be detected is learnt too, and fades within
        `steered.forget_s`. Of what may be a call little is learnt, the less the surer it is: noise that was
        taken for one does not stay unknown.
        """
        if self._to_learn <= 0:
            self._watch(call)
            self._strange_hops = self._strange_hops + 1 if self._strange[0] else 0
            busy = call or self._strange[0]
            self._busy_s = max(0.0, self._busy_s + self._elapsed_s * (1.0 if busy else -2.0))
            # rotors have started: every frame in the ring is of now
            if self._strange_hops > self._lag or self._busy_s > LONGEST_S:
                self._begin_anew()
        self._to_judge = min(self._to_judge + 1, self._lag + 1)
        while self._to_judge > (self._lag if self._to_learn <= 0 else 0):
            self._to_judge -= 1
            self._learn(self._to_judge)

    def _learn(self, ago: int) -> None:
        """The frame of so many hops ago."""
        patient = self._to_learn <= 0 and self._bad_hops <= self._patience
        if self._silent[-1 - ago] or (patient and self._failing[-1 - ago]):
            return
        surest = max(self._since_lag) if self._to_learn <= 0 else 0.0
        caution = min(1.0, (self._least_ratio / max(surest, 1e-9)) ** 2)
        share = max(1.0 - math.exp(-self._elapsed_s / self._forget_s), 1.0 / (self._learnt_frames + 1))
        self._search.learn(caution * share, ago)
        self._learnt_frames += 1
        self._to_learn = max(self._to_learn - 1, 0)

    def _watch(self, call: bool) -> None:
        """What the noise's scores are, put aside until it is sure that they are the noise's."""
        self._since_lag.append(max(self._ratios))
        self._quiet_hops = 0 if call else self._quiet_hops + 1
        if self._to_judge < self._lag:
            # just learnt from a few frames, and no more since: the noise is as unknown as it was
            self._quiet_hops = 0
            return
        quiet = self._quiet_hops * self._hop_s > PAUSE_S  # a call fades out, and its pauses are no noise
        for span in range(len(self._spans_s)):
            if not quiet:
                self._search.doubt(span)
            elif not self._strange[span] and self._scores[span] is not None:  # it was searched
                self._search.watch(span)
            if quiet and self._quiet_hops % self._lag == 0:
                self._search.settle(1.0 - math.exp(-self._hop_s / WATCH_S), span)
        for usual, score in zip(self._usual, self._scores, strict=True):
            if score is not None and not call and usual.ratio(score) < self._least_ratio:
                usual.learn(score, self._elapsed_s)
            else:
                usual.age(self._elapsed_s)
        if not self._usual[0].young and max(self._since_lag) < self._least_ratio:
            self._onsets.learn(self._lag, self._elapsed_s)


def _may_be_elsewhere(source: Source) -> bool:
    """Whether another lobe explains what was heard nearly as well."""
    return source.rival > min(RIVAL, 1.0 - CLOSER / math.sqrt(max(source.score, 1.0)))
