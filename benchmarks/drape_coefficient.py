"""Drape coefficients after Cusick: equilibria against the ends of long damped rollouts.

    python -m benchmarks.drape_coefficient
    python -m benchmarks.drape_coefficient --quick     # seconds: shows that it runs

A disk of cloth, 30 cm wide, lies with its middle on a pedestal of 18 cm and hangs over the rim. The
drape coefficient is the area of its shadow beyond the pedestal as a part of that of the flat ring:
100 % for a stiff plate. For five bending stiffnesses the disk falls for `--seconds`; `fold` into
that rollout, `simulator.equilibrium` starts from its state. Where a disk folds there are many
equilibria, which differ by how many folds lie where: from the flat start the same equilibrium need
not be found.

Columns: bending stiffness [mJ]; drape coefficient at the end of the rollout and at equilibrium [%];
largest distance of a vertex between the two, and that of the equilibrium from the flat start [m];
how fast the rollout still moves at its end [m/s]; processor time of the rollout and of the
equilibrium as a part of it.
"""
