"""Physical effects, a file for each family, and the list of them.

Mechanisms come first, then closed forms of any channel. `sealfit.effects.free` builds free shapes, whose
number of parameters depends on the data; `sealfit.effects.user` reads the effects of users; `contract`
describes an effect.
"""

from sealfit.effects import aging_laws, closed_forms, sensors, sliding, warming
from sealfit.effects.contract import effects_in

FAMILIES = (warming, sensors, sliding, aging_laws, closed_forms)

EFFECTS = {effect.id: effect for family in FAMILIES for effect in effects_in(family)}
