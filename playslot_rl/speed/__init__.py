"""`playslot bench`: how fast this machine is, and what a training step costs. Nothing is imported here.

`torch.utils.benchmark` times. The fast paths race plain code in `tests/benchmarks`.
"""
