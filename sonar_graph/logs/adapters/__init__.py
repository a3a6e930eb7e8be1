"""Other people's messages as measurements, without code: an adapter a role says which fields hold what, and how.

`shipped` lists the adapters for common drivers, found by message type; `config` reads more of them, or changes to
them, from a TOML file. Both are the same classes.
"""
