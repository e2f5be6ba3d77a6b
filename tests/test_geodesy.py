"""Places on the ellipsoid, held against PROJ."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge import geodesy

CENTRED = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
LATITUDES = st.floats(-90, 90)
LONGITUDES = st.floats(-180, 180)
ALTITUDES = st.floats(-500, 20_000)


@given(LATITUDES, LONGITUDES, ALTITUDES)
def test_centred_is_that_of_proj(lat, lon, alt):
    expected = CENTRED.transform(lon, lat, alt)
    assert geodesy.centred_m(lat, lon, alt) == pytest.approx(expected, abs=1e-6)


@given(LATITUDES, LONGITUDES, ALTITUDES)
def test_geodetic_is_the_way_back(lat, lon, alt):
    centred = geodesy.centred_m(lat, lon, alt)
    found = geodesy.geodetic(centred)
    assert geodesy.centred_m(*found) == pytest.approx(centred, abs=1e-5)
    assert found[0] == pytest.approx(lat, abs=1e-9)
    assert found[2] == pytest.approx(alt, abs=1e-5)


@given(LATITUDES, LONGITUDES)
def test_axes_are_orthonormal_and_right_handed(lat, lon):
    axes = geodesy.axes(lat, lon)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


@given(st.floats(-89.9, 89.9), LONGITUDES, st.floats(-math.pi, math.pi), st.floats(1, 2000))
def test_a_move_has_the_azimuth_and_length_of_the_geodesic(lat, lon, azimuth, length):
    """On the plane, not along the ground: 2 km are longer by a tenth of a millimetre."""
    there = np.array([length * math.cos(azimuth), length * math.sin(azimuth), 0.0])
    end_lat, end_lon, _ = geodesy.moved(lat, lon, 0.0, there)
    found, _, distance = pyproj.Geod(ellps="WGS84").inv(lon, lat, end_lon, end_lat)
    assert distance == pytest.approx(length, abs=1e-3)
    assert length * math.radians((found - math.degrees(azimuth) + 180) % 360 - 180) == pytest.approx(
        0, abs=1e-3
    )


@given(LATITUDES, LONGITUDES, ALTITUDES, st.tuples(*[st.floats(-2000, 2000)] * 3))
def test_north_east_down_is_the_way_back_of_a_move(lat, lon, alt, there):
    place = geodesy.moved(lat, lon, alt, np.array(there))
    assert geodesy.north_east_down_m(*place, lat, lon, alt) == pytest.approx(there, abs=1e-4)
