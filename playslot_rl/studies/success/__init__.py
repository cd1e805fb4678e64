"""Success of policies, by demonstrations, labels or environment steps."""
