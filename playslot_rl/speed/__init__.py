"""`playslot bench`: this machine's speed as ratios of medians, fast path against plain path, in one run.

Torch cases run in child processes, because the allocator's setting cannot be undone in a process. The children of a
case are all started first; then they take turns, one step each a round, one at a time, so that every variant sees the
same state of the machine. Nothing is imported here.
"""
