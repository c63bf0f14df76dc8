"""Physical effects, one file each, and the list of them.

Mechanisms come first, then closed forms of any channel. Free shapes, whose size depends on the data, are built by
`sealfit.effects.free` and `categories`; the users' own effects are read by `sealfit.effects.user`. What a file holds
is in `contract`.
"""

from sealfit.effects.aging_delay import AGING_DELAY
from sealfit.effects.aging_floor import AGING_FLOOR
from sealfit.effects.aging_induction import AGING_INDUCTION
from sealfit.effects.arrhenius_aging import ARRHENIUS_AGING
from sealfit.effects.asymmetry import ASYMMETRY
from sealfit.effects.bilinear import BILINEAR
from sealfit.effects.bilinear_log import BILINEAR_LOG
from sealfit.effects.bilinear_logs import BILINEAR_LOGS
from sealfit.effects.bump import BUMP
from sealfit.effects.campaign_drift import CAMPAIGN_DRIFT
from sealfit.effects.compression_factor import COMPRESSION_FACTOR
from sealfit.effects.conditioning import CONDITIONING
from sealfit.effects.drift import DRIFT
from sealfit.effects.exponential_approach import EXPONENTIAL_APPROACH
from sealfit.effects.grosch_peak import GROSCH_PEAK
from sealfit.effects.humidity import HUMIDITY
from sealfit.effects.hyperbolic import HYPERBOLIC
from sealfit.effects.lab_temperature import LAB_TEMPERATURE
from sealfit.effects.linear import LINEAR
from sealfit.effects.linear_each_way import LINEAR_EACH_WAY
from sealfit.effects.load_exponent import LOAD_EXPONENT
from sealfit.effects.log import LOG
from sealfit.effects.log_growth import LOG_GROWTH
from sealfit.effects.log_rate import LOG_RATE
from sealfit.effects.offset_slope import OFFSET_SLOPE
from sealfit.effects.power import POWER
from sealfit.effects.power_viscous import POWER_VISCOUS
from sealfit.effects.product import PRODUCT
from sealfit.effects.product_log import PRODUCT_LOG
from sealfit.effects.product_logs import PRODUCT_LOGS
from sealfit.effects.quadratic import QUADRATIC
from sealfit.effects.rest_strengthening import REST_STRENGTHENING
from sealfit.effects.ripple import RIPPLE
from sealfit.effects.run_in import RUN_IN
from sealfit.effects.saturation import SATURATION
from sealfit.effects.sinusoid import SINUSOID
from sealfit.effects.sinusoid_harmonics import SINUSOID_HARMONICS
from sealfit.effects.step import STEP
from sealfit.effects.stribeck_exponent import STRIBECK_EXPONENT
from sealfit.effects.stribeck_speed_aging import STRIBECK_SPEED_AGING
from sealfit.effects.viscosity_aging import VISCOSITY_AGING
from sealfit.effects.warming_conduction import WARMING_CONDUCTION
from sealfit.effects.warming_conduction_load import WARMING_CONDUCTION_LOAD
from sealfit.effects.warming_distance import WARMING_DISTANCE
from sealfit.effects.warming_power import WARMING_POWER
from sealfit.effects.warming_time import WARMING_TIME
from sealfit.effects.zero_offset import ZERO_OFFSET

EFFECTS = {
    effect.id: effect
    for effect in (
        WARMING_TIME,
        WARMING_DISTANCE,
        WARMING_POWER,
        WARMING_CONDUCTION,
        WARMING_CONDUCTION_LOAD,
        RIPPLE,
        DRIFT,
        ZERO_OFFSET,
        OFFSET_SLOPE,
        ASYMMETRY,
        CONDITIONING,
        RUN_IN,
        REST_STRENGTHENING,
        CAMPAIGN_DRIFT,
        LOAD_EXPONENT,
        STRIBECK_EXPONENT,
        LOG_RATE,
        POWER_VISCOUS,
        GROSCH_PEAK,
        ARRHENIUS_AGING,
        COMPRESSION_FACTOR,
        AGING_FLOOR,
        AGING_INDUCTION,
        AGING_DELAY,
        STRIBECK_SPEED_AGING,
        VISCOSITY_AGING,
        LAB_TEMPERATURE,
        HUMIDITY,
        LINEAR,
        LINEAR_EACH_WAY,
        QUADRATIC,
        PRODUCT,
        PRODUCT_LOG,
        PRODUCT_LOGS,
        BILINEAR,
        BILINEAR_LOG,
        BILINEAR_LOGS,
        LOG,
        LOG_GROWTH,
        POWER,
        EXPONENTIAL_APPROACH,
        SATURATION,
        HYPERBOLIC,
        STEP,
        BUMP,
        SINUSOID,
        SINUSOID_HARMONICS,
    )
}
