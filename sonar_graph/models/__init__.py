"""Measurement models, below every estimator: what a sensor measures at a state, its derivatives and its noise.

sonar.py       range and azimuth of a landmark, and the inverse
aiding.py      headings and position fixes, with Huber's kernel
biases.py      biases that last through a run, and what they do to a motion
kernels.py     robust kernels of range and azimuth
identity.py    acceptance of a recogniser's identities, and the gate
"""
