"""Eclipse Zenoh: sessions, key names, endpoints, access control, diagnosis of TLS.

No messages: the protocol between a run and its hosts is `cosim.hosts`.
"""
