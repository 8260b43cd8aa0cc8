"""How a rig is reached: in process, over Modbus, over a serial line, or replayed from a recording."""
