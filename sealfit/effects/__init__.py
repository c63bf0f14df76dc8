"""Physical effects, a file for each family, and the list of them.

Mechanisms come first, then closed forms of any channel. Free shapes, whose size depends on the data, are built by
`sealfit.effects.free`; the users' own effects are read by `sealfit.effects.user`. What an effect holds is in
`contract`.
"""

from sealfit.effects import aging_laws, closed_forms, history, products, sensors, sliding, warming
from sealfit.effects.contract import Effect

FAMILIES = (warming, sensors, history, sliding, aging_laws, closed_forms, products)

EFFECTS = {effect.id: effect for family in FAMILIES for effect in vars(family).values() if isinstance(effect, Effect)}
