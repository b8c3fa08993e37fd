"""Clinical joint angles of a motion; range of motion, gait, repetitions and joint torques from them.

Motion -> `angles.clinical_angles` -> `ClinicalAngles` -> the analyses. Each result has `notes` on what could
not be determined, and why.
"""
