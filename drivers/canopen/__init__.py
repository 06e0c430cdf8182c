"""The CANopen master: network, SDO, PDO, NMT, LSS, heartbeats (CiA 301, 305)."""
