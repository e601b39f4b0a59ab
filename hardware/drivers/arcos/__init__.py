"""ARCOS, the serial protocol of Pioneer and AmigoBot robots: codec, parameters of the robots, an emulated robot.

`packet` frames, `commands`, `sip` and `config` say what is inside, `robots` holds the constants of each kind of robot.
`device` with `motion` is a robot without hardware and without a clock, and `serve` puts it on a pseudo-terminal or a TCP port,
over a `wire`.
"""
