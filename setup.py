"""Only what pyproject.toml cannot say: what is made before packing, and one abi3 wheel for Python >= 3.11."""

import importlib.util

from setuptools import setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

spec = importlib.util.spec_from_file_location("build_dialect", "locagen_edge/mavlink/build_dialect.py")
build_dialect = importlib.util.module_from_spec(spec)
spec.loader.exec_module(build_dialect)


class _WithMessages:
    """Makes the MAVLink messages in the source tree: wheels, editable installs, `build_ext --inplace`."""

    def run(self):
        if not build_dialect.fresh():
            build_dialect.generate()
        super().run()


class BuildPy(_WithMessages, build_py):
    pass


class BuildExt(_WithMessages, build_ext):
    pass


setup(
    cffi_modules=["csrc/build_kernel.py:ffi"],
    cmdclass={"build_py": BuildPy, "build_ext": BuildExt},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
