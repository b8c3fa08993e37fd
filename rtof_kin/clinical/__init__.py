"""Clinical joint angles of a motion and what is read from them: range, gait, repetitions, torques.

Motion -> `angles.clinical_angles` -> `ClinicalAngles` -> the analyses. Every result carries `notes`: what
could not be told, and why.
"""
