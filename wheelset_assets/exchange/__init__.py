"""Formats that others read and write: MiniProf profiles, SIMPACK profiles, Q-DAS measurements. Bytes in, tables out, and back.

Profiles here are two arrays in the project's section frame: `s_mm` lateral, 0 on the datum circle, positive to the field
side (the back face at −70), and `z_mm` radial, positive outward, 0 at the datum circle. Nothing here reads a file by name.
"""
