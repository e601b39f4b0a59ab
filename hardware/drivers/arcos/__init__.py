"""ARCOS, the serial protocol of Pioneer and AmigoBot robots. The emulated robot is in `hardware.emulators.arcos`.

`packet` frames; `command_numbers`, `sip` and `config_packet` are the content; `robot_parameters` holds the constants of each
robot; `driver` with `handshake`, `command_schedule` and `samples` drives one.
"""
