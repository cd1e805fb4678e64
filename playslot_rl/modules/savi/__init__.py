"""SAVi (Kipf et al., 2022), one part a file."""

from playslot_rl.modules.savi.savi import Decoded, SAVi

__all__ = ["Decoded", "SAVi"]
