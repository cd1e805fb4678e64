"""Looking after LeRobot v3.0 data sets on disk: info, verify, repair, merge, split, viz.

They work for any such data set, image or video, not only ours, and never change one in place: a new one is written
under a temporary name, verified and renamed.

Note: these modules read and write the format's own files (parquet, PNG, mp4, JSON) and import neither torch nor
LeRobot's Python package, whose import alone takes seconds; `tests/datasets` checks every result with LeRobotDataset.
"""
