"""Derivatives of contacts along several directions: each has the bits that it has alone."""

import numpy as np

from diffcloth_torch import _kernels as kernels


def test_neither_company_nor_instructions_change_a_bit():
    """The arithmetic is tested through potentials; here it is that of every level and lane."""
    expected = kernels.directions(kernels.kernel_levels()[0], alone=True)
    assert np.isfinite(expected).all()
    assert len({row.tobytes() for row in np.moveaxis(expected, -1, 0)}) == 8
    for level in kernels.kernel_levels():
        for alone in (True, False):
            np.testing.assert_array_equal(kernels.directions(level, alone=alone), expected)
