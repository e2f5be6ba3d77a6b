"""The C kernel, seen from Python: the one file that touches cffi.

cffi hands a pointer to C without asking what lies behind it (a float64 array passes for `float *` in
silence), so everything is checked here, before the pointer. The C side is described in `csrc/locagen.h`.
"""

import numpy as np
import numpy.typing as npt

from locagen_edge._kernel import ffi, lib
from locagen_edge.errors import KernelError

_FLOAT32 = np.dtype(np.float32)
_FLOATS = ffi.typeof("float[]")


class GccPhat:
    """GCC-PHAT of all microphone pairs of one frame, at the lags that the geometry allows.

    Hann window, real FFT, each bin scaled by `1 / sqrt(p + f)` where `p` is its power and `f` the larger of
    `floor` and `relative_floor` times the microphone's mean bin power in the band; then, for a pair
    `(i, j)`, the mean over the band's bins of `Re(U_j conj(U_i) exp(2 pi i f tau))`. A pair that is coherent
    over the band peaks at 1.0 (less what the floor takes), at a positive lag where `j` hears later.
    Silence gives zeros. Source: Knapp & Carter 1976, "The generalized correlation method for estimation
    of time delay".

    Args:
        mics: microphones, 2 to 8.
        frame: samples per microphone and frame, a power of two from 256 to 4096.
        lags: grid points each side of zero.
        oversample: grid points per sample, 1 to 64; the longest lag, `lags / oversample` samples, stays
            below a quarter of the frame.
        rate_hz: sample rate.
        band_hz: lowest and highest frequency that count, both included.
        floor: power of one bin, mean square of full scale, around which a bin fades to zero;
            the default, 1e-12, is -120 dB, under the converter's noise.
        relative_floor: the same as a share of the microphone's mean bin power in the band; the default,
            1e-3, keeps bins that are empty of the source (-30 dB) from being blown up to its size.

    Raises:
        KernelError: the configuration is none that the kernel can do; the text names the fault.

    Attributes:
        pairs: `(i, j)` with `i < j`, in the order of the correlation's rows.
        lag_s: delay of each column in seconds, float64, shape `(2 * lags + 1,)`.

    One object serves one thread. Frames stand alone: there is nothing to reset.
    """

    def __init__(
        self,
        *,
        mics: int,
        frame: int,
        lags: int,
        oversample: int,
        rate_hz: float,
        band_hz: tuple[float, float] = (300.0, 4700.0),
        floor: float = 1e-12,
        relative_floor: float = 1e-3,
    ) -> None:
        try:
            config = ffi.new(
                "locagen_gcc_config *",
                {
                    "mics": mics,
                    "frame": frame,
                    "lags": lags,
                    "oversample": oversample,
                    "rate_hz": rate_hz,
                    "band_low_hz": band_hz[0],
                    "band_high_hz": band_hz[1],
                    "floor": floor,
                    "relative_floor": relative_floor,
                },
            )
        except (OverflowError, TypeError) as fault:
            raise KernelError(f"kernel configuration: {fault}") from fault
        # With a size of 0, init refuses the configuration before it touches the one byte.
        self._memory = ffi.new("char[]", max(1, lib.locagen_gcc_sizeof(config)))
        self._state = ffi.cast("locagen_gcc *", self._memory)
        code = lib.locagen_gcc_init(self._state, config)
        if code < 0:
            raise KernelError(ffi.string(lib.locagen_strerror(code)).decode())
        self.pairs = tuple((i, j) for i in range(mics) for j in range(i + 1, mics))
        self.lag_s: npt.NDArray[np.float64] = np.arange(-lags, lags + 1) / (oversample * float(rate_hz))
        self._shape = (mics, frame)
        # C writes here, the caller gets copies: that is faster than a new pointer for every new array.
        self._correlation = np.empty((len(self.pairs), 2 * lags + 1), _FLOAT32)
        self._power = np.empty(mics, _FLOAT32)
        self._correlation_pointer = ffi.from_buffer(_FLOATS, self._correlation)
        self._power_pointer = ffi.from_buffer(_FLOATS, self._power)
        self._process = lib.locagen_gcc_process

    def process(
        self, samples: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], int]:
        """Correlates one frame.

        Args:
            samples: float32, C-contiguous, shape `(mics, frame)`, full scale 1.0; left as it is.

        Returns:
            The correlation, float32, shape `(pairs, 2 * lags + 1)`; the mean square of each microphone in
            the band, corrected for the window, float32, shape `(mics,)`; and a mask with bit `m` set where
            microphone `m` held a sample that is not finite, or so large that its power overflowed: it
            counts as silent and its power is 0. The arrays are new with every call.

        Raises:
            KernelError: `samples` has another type, shape or memory layout.
        """
        try:
            # Comparing types by identity first: the comparison by value takes longer than the rest.
            if (samples.dtype is not _FLOAT32 and samples.dtype != _FLOAT32) or samples.shape != self._shape:
                raise KernelError(
                    f"samples: {samples.dtype} {samples.shape} given, float32 {self._shape} needed"
                )
            source = ffi.from_buffer(_FLOATS, samples)
        except (AttributeError, TypeError, ValueError, BufferError) as fault:
            raise KernelError(f"samples: a C-contiguous float32 array is needed: {fault}") from fault
        bad: int = self._process(self._state, source, self._correlation_pointer, self._power_pointer)
        return self._correlation.copy(), self._power.copy(), bad
