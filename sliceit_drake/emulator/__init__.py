"""A UR e-Series controller emulated on the loopback interface, driven by a simulated robot.

`process.EmulatorProcess` runs one in a process of its own, for tests; `sliceit emulate` is the same
for people. `emulator.Emulator` puts the parts together.
"""
