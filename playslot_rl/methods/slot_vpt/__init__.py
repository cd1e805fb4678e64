"""VPT on slots: actions that a few labels teach to tell from slots, cloned from all videos."""
