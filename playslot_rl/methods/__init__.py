"""Methods: a folder each, with its `Method` in `method.py`; docs/tutorials/add-a-method.md brings another one."""

from playslot_rl.config.methods import METHODS as METHODS
from playslot_rl.config.methods import Load as Load
from playslot_rl.config.methods import Method as Method
from playslot_rl.config.methods import Style as Style
from playslot_rl.config.stage_spec import StageSpec as StageSpec
