"""The rack: takes outputs, gives measurements, one tick at a time, by its own clock."""
