"""The operator's page: a Modbus client of the three services that serves what it reads to browsers."""
