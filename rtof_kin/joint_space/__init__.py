"""The fragment solver on the skeleton's own configuration: rigid bones, whole orientations, limits.

``state`` is what is optimised, ``frame_energy`` one frame's energy as symbols, ``problem`` a fragment's,
``levenberg_marquardt`` and ``ipopt`` solve it, ``solver`` runs over a recording.
"""
