"""Entry points for external programs: UDP, IP, WSS, Zenoh. A gateway knows datagrams and rows of vehicles, not the channel."""
