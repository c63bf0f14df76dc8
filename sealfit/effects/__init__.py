"""Physical effects, a file for each family, and the list of them: mechanisms first, then closed forms."""

from sealfit.effects import aging_laws, closed_forms, sensors, sliding, warming
from sealfit.effects.contract import effects_in

FAMILIES = (warming, sensors, sliding, aging_laws, closed_forms)

EFFECTS = {effect.id: effect for family in FAMILIES for effect in effects_in(family)}
