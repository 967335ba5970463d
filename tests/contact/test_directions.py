"""Derivatives of contacts along several directions have the bits of single directions."""

import numpy as np

from diffcloth_torch import _kernels as kernels


def test_neither_company_nor_instructions_change_a_bit():
    """Every instruction level and lane agrees; tests of potentials check the values."""
    expected = kernels.directions(kernels.kernel_levels()[0], alone=True)
    assert np.isfinite(expected).all()
    assert len({row.tobytes() for row in np.moveaxis(expected, -1, 0)}) == 8
    for level in kernels.kernel_levels():
        for alone in (True, False):
            np.testing.assert_array_equal(kernels.directions(level, alone=alone), expected)
