"""Motions of persons on humanoid robots: a table of links, inverse kinematics with contacts and limits, files."""
