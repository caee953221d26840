from shared import paper as paper
from shared import small as small
