"""What the network knows of itself without voltages: which buses hang together."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from pgexcite.core.network import islands


@pytest.mark.parametrize("seed", range(20))
def test_islands_are_the_connected_components(seed):
    draw = np.random.default_rng(seed)
    n, m = int(draw.integers(1, 30)), int(draw.integers(0, 25))
    ends = draw.integers(0, n, (m, 2))
    found = islands([f"b{k}" for k in range(n)], [(f"b{i}", f"b{j}") for i, j in ends])
    links = sp.coo_matrix((np.ones(m), (ends[:, 0], ends[:, 1])), shape=(n, n))
    _, label = connected_components(links, directed=False)
    assert found == {f"b{k}": tuple(f"b{i}" for i in np.flatnonzero(label == label[k])) for k in range(n)}
