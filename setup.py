"""Only what pyproject.toml cannot say: the cffi module, and one abi3 wheel for all Pythons >= 3.11."""

from setuptools import setup

setup(
    cffi_modules=["csrc/build_kernel.py:ffi"],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
