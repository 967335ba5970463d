"""Initial values for real fabrics, from published measurements.

>>> sheet = dc.Cloth.grid((24, 24), material=dc.fabrics.material("denim", thickness=6e-4))

The numbers are from the database of H. Wang, J. F. O'Brien and R. Ramamoorthi, Data-Driven Elastic
Models for Cloth: Modeling and Measurement, ACM Trans. Graph. 30(4), 71, 2011
(graphics.berkeley.edu/papers/Wang-DDE-2011-08). For each sample it contains the mass per area, the
stiffnesses c11, c22 and c33 of the law between tension and strain at small strain [N/m], and the
bending stiffness k of hinges on lines at 0, 45 and 90 degrees to direction 1 at small curvature
[N m]. With direction 2, the stiffer one in all samples, as the warp:

    stretch = c22, stretch_weft = c11, stretch_shear = c33
    bending = k(0) / 4, bending_weft = k(90) / 4, bending_twill = k(45) / 4

A line at 0 degrees bends direction 2. The factor 1/4 relates a plate to the energy k l^2 theta^2 /
(8 A) of a hinge of length l and angle theta in two faces of area A, on a mesh of equilateral
triangles. The database names neither the warp nor the measure of strain: with another measure than
stretch minus one, the stiffnesses of stretch would be up to twice as large.

These are initial values, not your fabric. Real cloth stiffens as it is stretched, contracts
sideways (c12, which has no counterpart here) and has hysteresis; samples of one name differ by more
than any of these effects. Quantities that were not measured (Poisson ratio, damping, friction,
thickness) have the defaults of `Material`. `dc.fit` estimates the numbers of your fabric: see
Identification.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from diffcloth_torch.checks import check_choice
from diffcloth_torch.model.materials import Material

__all__ = ["MEASUREMENTS", "Measurement", "material"]


class Measurement(NamedTuple):
    """A sample of the database.

    Attributes:
        sample: Name in the database.
        composition: Fibers and typical use.
        density: Mass per area [kg/m^2].
        tension: c11 and c22 [N/m].
        shear: c33 [N/m].
        bending: k at 0, 45 and 90 degrees [N m].
    """

    sample: str
    composition: str
    density: float
    tension: tuple[float, float]
    shear: float
    bending: tuple[float, float, float]


def _measurement(
    sample: str,
    composition: str,
    density: float,
    tension: tuple[float, float],
    shear: float,
    micro_bending: tuple[float, float, float],
) -> Measurement:
    k0, k45, k90 = (1e-6 * k for k in micro_bending)
    return Measurement(sample, composition, density, tension, shear, (k0, k45, k90))


MEASUREMENTS: Mapping[str, Measurement] = MappingProxyType(
    {
        "denim": _measurement(
            "11oz-black-denim",
            "99 % cotton, 1 % spandex: jeans",
            0.324, (205.352005, 1013.88629), 53.387184, (64.196457, 73.384567, 96.951576),
        ),
        "trouser_cloth": _measurement(
            "royal-target",
            "65 % cotton, 35 % polyester: trousers",
            0.220, (2016.55456, 2034.97644), 104.759674, (125.409805, 107.997696, 125.409805),
        ),
        "tablecloth": _measurement(
            "white-dots-on-blk",
            "polyester: tablecloths",
            0.128, (2002.08618, 2027.48559), 19.189022, (51.713814, 40.659470, 31.282822),
        ),
        "windbreaker": _measurement(
            "tango-red-jet-set",
            "polyester: light jackets",
            0.113, (43.067627, 171.424835), 14.314700, (14.293814, 21.951700, 20.345654),
        ),
        "blanket": _measurement(
            "pink-ribbon-brown",
            "polyester: blankets",
            0.228, (151.503906, 244.830673), 30.250183, (117.070122, 87.509773, 59.774277),
        ),
        "ponte": _measurement(
            "camel-ponte-roma",
            "60 % polyester, 40 % rayon: knitted jackets",
            0.284, (31.146198, 44.028667), 31.896357, (36.348366, 33.013252, 37.157593),
        ),
        "interlock": _measurement(
            "gray-interlock",
            "60 % cotton, 40 % polyester: T-shirts",
            0.187, (16.593832, 34.477123), 36.860302, (23.191698, 24.749964, 14.267624),
        ),
        "rib_knit": _measurement(
            "ivory-rib-knit",
            "95 % cotton, 5 % spandex: underwear",
            0.276, (42.871021, 65.166023), 83.175644, (46.237591, 30.015930, 32.243889),
        ),
    }
)  # fmt: skip
"""Name -> measurement."""


def material(name: str, **changes: Any) -> Material:
    """Make the material of a fabric.

    Args:
        name: One of `MEASUREMENTS`.
        **changes: Fields of `Material` to set to other values.

    Raises:
        InvalidInput: If the name is unknown, or a value is not accepted.
    """
    measured = MEASUREMENTS[check_choice("fabrics.material: `name`", name, list(MEASUREMENTS))]
    weft, warp = measured.tension
    bending = [0.25 * k for k in measured.bending]
    values: dict[str, Any] = {
        "density": measured.density,
        "stretch": warp,
        "stretch_weft": weft,
        "stretch_shear": measured.shear,
        "bending": bending[0],
        "bending_twill": bending[1],
        "bending_weft": bending[2],
    }
    return Material(**values | changes)
