"""Reads the laws of a sensor file: a median dark rate, dark counts over temperature, efficiency over wavelength.

    [sensor] of a file --resolved--> the same without laws, as a sensor class takes it
    dark rate = stated rate * 2^((temperature - dark_reference) / dark_doubling)

`SensorKeys` declares the keys; each is optional, and a missing one changes no bit. They are laws of the file: the
sensor that comes out of them has one dark rate and one efficiency. A clip of one band has one wavelength, that of its
camera; the bands of a colour clip have one each, and each light is taken at that wavelength alone. Between the points
of a curve the efficiency is linear.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from qsim.kinds import NotNegative, Positive
from qsim.records import convert
from qsim.sensor.defects.fixed_pattern import DarkSpread
from qsim.settings import setting

DARK = {"QIS": "dark_current", "SpikeCamera": "dark_current"}  # of other models: dark_count_rate
EFFICIENCY = {"QIS": "quantum_efficiency", "SpikeCamera": "quantum_efficiency"}  # of other models: pde
# degrees C
COLDEST = -273.15
HOTTEST = 300.0
WAVELENGTH = 550e-9  # m, where no clip states another: that of cameras

Celsius = Annotated[float, Meta(ge=COLDEST, le=HOTTEST)]
Point = tuple[Annotated[float, Meta(ge=1e-7, le=2e-5)], Annotated[float, Meta(ge=0.0, le=1.0)]]  # m, efficiency
Curve = Annotated[tuple[Point, ...], Meta(min_length=2)]  # of rising wavelength


@dataclass(frozen=True, kw_only=True)
class Laws:
    """The keys of [sensor] that are laws of the file."""

    median: Annotated[
        NotNegative | None,
        setting("dark rate of the median pixel, in place of the mean (dark_count_rate)", unit="1/s", example=0.4),
    ] = None
    dark_doubling: Annotated[
        Annotated[float, Meta(ge=0.1, le=1e12)] | None,
        setting("the dark rate doubles per so many kelvin", unit="K", example=8.0),
    ] = None
    dark_reference: Annotated[
        Celsius | None, setting("temperature at which the dark rate is stated", unit="degrees C", example=25.0)
    ] = None
    temperature: Annotated[
        Celsius | None,
        setting("temperature of the sensor", unit="degrees C", unset="dark_reference", example=40.0),
    ] = None
    qe_curve: Annotated[
        Curve | None,
        setting(
            "points (wavelength in m, efficiency) of a curve, in place of the efficiency",
            example=[[450e-9, 0.30], [550e-9, 0.50], [650e-9, 0.35]],
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class SensorKeys(Laws):
    """The keys of [sensor] of any model: laws of the file."""

    iso: Annotated[
        Positive | None,
        setting("QIS: gain = iso / 100 (2^bits - 1 - offset) / full_well, in place of gain", example=100),
    ] = None


KEYS = tuple(field.name for field in fields(Laws))
_AS_IN = "as in [[450e-9, 0.3], [650e-9, 0.4]]"


@dataclass(frozen=True)
class Conditions:
    """What a sensor file is read for; None: as the file states it."""

    temperature: float | None = None  # degrees C
    wavelength: float | None = None  # m, of light of one band; None: WAVELENGTH
    dark: DarkSpread | None = None  # the spread of dark rates that makes a mean of a median


NOTHING = Conditions()


def resolved(table: Mapping[str, Any], where: str, conditions: Conditions = NOTHING) -> dict[str, Any]:
    """Return a table [sensor] without these laws, its dark rate and efficiency as they give them; `ValueError`."""
    plain = {key: value for key, value in table.items() if key not in KEYS}
    laws = convert({key: table[key] for key in KEYS if key in table}, Laws, where)
    model = table.get("model")
    dark = DARK.get(str(model), "dark_count_rate")
    efficiency = EFFICIENCY.get(str(model), "pde")
    if laws.median is not None:
        if dark in table:
            raise ValueError(f"{where}: {dark} (a mean) and median state the dark rate twice; leave one out")
        plain[dark] = laws.median * (1.0 if conditions.dark is None else conditions.dark.mean)
    if (factor := dark_factor(laws, where, conditions.temperature)) != 1:
        if dark not in plain:
            raise ValueError(f"{where}: {dark} is missing; dark_doubling is the law of a stated dark rate")
        plain[dark] = convert(plain[dark], NotNegative, f"{where}: {dark}") * factor
    if laws.qe_curve is not None:
        if efficiency in table:
            raise ValueError(f"{where}: {efficiency} and qe_curve state the efficiency twice; leave one out")
        plain[efficiency] = efficiency_at(laws.qe_curve, conditions.wavelength or WAVELENGTH, where)
    return plain


def dark_factor(laws: Laws, where: str, temperature: float | None = None) -> float:
    """Return the dark rate at a temperature [degrees C], or at that of the file, over the stated one; `ValueError`."""
    if laws.dark_doubling is None:
        for key in ("dark_reference", "temperature"):
            if getattr(laws, key) is not None:
                raise ValueError(f"{where}: {key} needs dark_doubling, the kelvin per doubling of the dark rate")
        if temperature is not None:
            raise ValueError(
                f"{where}: has no law of temperature; give it dark_doubling and dark_reference, or leave "
                "the temperature out"
            )
        return 1.0
    if laws.dark_reference is None:
        raise ValueError(f"{where}: dark_doubling needs dark_reference, the degrees C of the stated dark rate")
    doubling = laws.dark_doubling
    reference = laws.dark_reference
    own = reference if laws.temperature is None else laws.temperature
    here = own if temperature is None else temperature
    if not COLDEST <= here <= HOTTEST:
        raise ValueError(f"{where}: the temperature is in degrees C, {COLDEST:g} to {HOTTEST:g}, got {here!r}")
    power = (here - reference) / doubling
    if abs(power) > 100:
        raise ValueError(
            f"{where}: {here:g} degrees C are {power:.3g} doublings of the dark rate; at most 100 are taken"
        )
    return float(2.0**power)


def temperature_of(table: Mapping[str, Any], temperature: float | None) -> float | None:
    """Return the temperature [degrees C] that a checked table is read at; None without a law."""
    if "dark_doubling" not in table:
        return None
    return float(temperature if temperature is not None else table.get("temperature", table["dark_reference"]))


def efficiency_at(curve: Any, wavelength: float, where: str) -> float:
    """Return the efficiency of a curve [[m, efficiency], ...] at a wavelength [m]; `ValueError` outside of it."""
    points = convert(curve, Curve, f"{where}: qe_curve", cure=_AS_IN)
    lengths = [length for length, _ in points]
    if any(after <= before for before, after in itertools.pairwise(lengths)):
        raise ValueError(f"{where}: qe_curve: expected points of rising wavelength, {_AS_IN}; got {curve!r:.200}")
    if not lengths[0] <= wavelength <= lengths[-1]:
        span = f"{1e9 * lengths[0]:g} to {1e9 * lengths[-1]:g} nm"
        raise ValueError(f"{where}: qe_curve covers {span}, and the light has {1e9 * wavelength:g} nm; extend it")
    found = float(np.interp(wavelength, lengths, [efficiency for _, efficiency in points]))
    if found <= 0:
        raise ValueError(f"{where}: qe_curve is 0 at {1e9 * wavelength:g} nm, so this sensor sees no such light")
    return found
