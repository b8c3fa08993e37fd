"""The fragment solver on the skeleton's own configuration: rigid bones, whole orientations, hinges.

``state`` is what is optimised, ``frame_energy`` one frame's energy as symbols, ``problem`` a fragment's
and ``building`` keeps them; ``observations`` is a recording as they want it. ``solver`` runs over its
fragments with `rtof_kin.core.numerics.levenberg_marquardt` or ``ipopt``; ``annealing`` weighs the landmarks as it goes.
"""
