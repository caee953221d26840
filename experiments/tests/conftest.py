from __future__ import annotations

from shared import paper as paper
from shared import small as small
