"""Classical restorers, one file per method, one signature: restore(codes, sensor, exposure, ...)."""
