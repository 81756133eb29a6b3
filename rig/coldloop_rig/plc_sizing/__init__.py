"""What the reference PLC can do: its speed and memory, operations counted, budgets, certified iterations."""
