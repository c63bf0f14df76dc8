"""Every threshold of the loop, each with its reason; what only bounds time or memory stands where it is used."""

# ---------------------------------------------------------------- evidence: how many units a test needs
MANY_RUNS = 20
"""Runs from which a contrast inside files is judged between runs, as repeats share a set-up."""

LEAST_GROUPS_HELD_OUT = 6
"""Runs below which whole files are held out, and files below which strokes are."""

MOST_LEVELS = 100
"""Levels of a category above which a column names things rather than kinds of them."""

FEW_DF = 2
"""Columns of a free shape along fewer than `JACKKNIFE_UNITS` specimens: a line and a bend."""

FREE_DF = 4
"""Columns of a free shape: enough for a peak, an approach or a step; more only cost power."""

FINE_DF = 9
"""Columns of a second, finer shape, for two humps or a narrow one."""

FINE_UNITS = 50
"""Units from which the finer shape is tried."""

WITHIN = 1e-4
"""Share of a channel's variance within groups, below which it counts as constant there: 1 % of its standard deviation.

Measured speeds of one setting differ by 1e-5 to 1e-3 of themselves, settings by 10 % and more.
"""

SAME_VALUE = 1e-3
"""Of a channel's range on the scale it is looked at: values nearer to each other are one setting measured twice."""

MOST_SET_VALUES = 50
"""Of a channel that was set: one with more groups of values is taken as it was measured."""

JACKKNIFE_UNITS = 30
"""Units from which the jackknife over them is tried."""

PROMISING = 1e-3
"""P-value of what columns explain, before adjustment, below which the jackknife is computed."""

WORTH_THE_RUNS = 0.05
"""P-value, before adjustment, below which columns that are constant in a run are held against the scatter of runs."""

CONSTANT_IN_RUNS = 0.9
"""Share of the variance of columns that is one number a run, from which they are taken to be constant in runs."""

IDENTIFIABLE = 0.01
"""Share of a column's variance that the model must leave for its amplitude to be identifiable."""

SEARCHES = 2
"""Searches that share the level of error: single channels, and pairs of them."""

LOGARITHMIC_SPAN = 5.0
"""Ratio of largest to smallest value of a positive channel from which its logarithm is tried in pairs."""

RARE = 2.0
"""Factor on the p-values of pairs: they are many and seldom at work, and get half of their share of the error."""

MOST_CATEGORIES = 12
"""Levels of a category up to which a slope for each is tried."""

DOUBTFUL = 1e-4
"""P-value of a single channel above which pairs are searched too: a far smaller one may show in a pair."""


# ---------------------------------------------------------------- few units: slopes and means between specimens or runs
LEAST_UNITS_OF_SLOPES = 5
"""Units from which slopes are compared between them."""

LEAST_DF = 1.5
"""Satterthwaite degrees of freedom below which one or two units hold nearly all of a contrast: it is not tested."""

LARGEST_LEVERAGE = 0.98
"""Of a unit in a contrast; one with more owns it, and nothing else says how it scatters."""

LEAST_LEVERAGE = 0.05
"""Leverage from which a specimen says something of a contrast."""

AGREE = 0.1
"""P-value of Student's t over two to four specimens, above which their own slopes do not agree."""

CLOSELY = 0.005
"""The same p-value where the slopes differ by more than noise, so that they may agree by chance."""

DIFFER = 0.05
"""P-value of chi-squared below which the slopes of specimens differ by more than noise."""

LEAST_SPECIMENS = 2.5
"""Specimens, counted by their leverages, from which slopes along strokes may agree: two do too often by chance."""

LARGE = 0.01
"""Share of the force, root mean square: what changes along the strokes of every specimen by more, and the same way, is
no scatter of specimens. A straight line of that size changes by 3.5 % from end to end."""

LEAST_OWN_VARIANCE = 0.01
"""Share of a unit's variance that the model must leave for its number to count."""

KNOWN_DF = 8.0
"""Degrees of freedom that a variance counts for which runs and files explain."""

LEAST_KNOWN_DF = 0.5
"""Fewest of these degrees of freedom; with fewer the scale is free and no draw depends on it."""

LEAST_ERROR_DF = 4
"""Degrees of freedom left for the scatter of specimens, with fewer of which nothing is claimed."""

LEAST_ERROR_DF_OF_RUNS = 3
"""The same for runs: three speeds both ways leave three."""


# ---------------------------------------------------------------- ripples
SHARED_PHASE = 1e-3
"""P-value below which the phase of a ripple is taken to be common to all files."""

ABOVE_BACKGROUND = 4.0
"""Power of a peak over the median of its neighbours: a smooth trend has no peak."""

LEAST_FILES_OF_RIPPLE = 9
"""Files that a test of signs at 0.5 % needs: eight of one sign have p = 0.004, and one may be small."""

LEAST_SAMPLES_OF_STROKE = 16
"""Steady samples of a stroke with fewer of which it says nothing of a ripple."""

NEIGHBOURS = 25
"""Frequencies on each side of one that make its local background."""

LOBE = 4
"""Frequencies on each side over which the taper spreads a peak."""

REACHED = 0.25
"""Share of the strokes that must reach a frequency for it to be searched."""


# ---------------------------------------------------------------- forms: which are tried, and which is reported
MOST_KNOTS = 24
"""Knots of a penalised free shape, whose smoothness the data decide."""

UNITS_PER_KNOT = 3
"""Units of evidence for each knot of a free shape."""

KNOTS_APART = 1e-3
"""Of a channel scaled to -1..1: knots that are nearer are one value measured twice."""

REACH = 4.0
"""Spans of a channel that a width or a time constant may have."""

PAIR = 10.0
"""Deviance by which two channels together must be favoured over one, exp(5): there are many more to choose from."""

CONTENDER = 0.6
"""Share of the best explained sum of squares from which a rival channel is given forms."""

DOMINANT = 20.0
"""Fall of the deviance under an effect's own scatter from which it had stood in most of the scatter."""

HALF_OF_CALENDAR = 0.5
"""Share of what the calendar explains from which anything else comes before it."""

BEHIND = 60.0
"""Deviance by which a proposal may be behind under the best one's scatter and still be given one of its own."""

TIED = 3.0
"""Deviance below which two forms are equal: the simpler or more physical one is reported."""

RIVAL = 10.0
"""Deviance below which a form is a rival: the data favour the chosen one by less than exp(5)."""

HELD = 0.5
"""Relative standard error beyond which a form's own number is not determined."""

OVERTURNED = 1 / 3
"""Share of its size by which a new effect may change an earlier one, where the new one has equals."""

ALIKE = 0.5
"""Correlation below which two candidates explain different things."""

SAME_EFFECT = 0.98
"""Correlation above which two candidates are one effect in these data."""


# ---------------------------------------------------------------- held-out data, and what is accepted
MOST_HELD_OUT = 0.5
"""Share of the rows that blocks of the calendar must hold out."""

BLOCKS_OF_A_FOLD = (1, 2, 4)
"""Blocks of the calendar that a fold holds: as few as leave most rows held out once."""

BEYOND = 0.02
"""Of the range of what the fit saw, by which a held-out row may lie outside before it counts as extrapolated."""

SAME_SETTING = 0.01
"""Of a value, by which measured numbers of one setting may differ."""

SURE_OF_RIPPLE = 0.005
"""P-value over files (Wilcoxon) below which a ripple of free phase helps the half it was not fitted to."""

COMPARED = 4
"""Rivals, best first, that are put to held-out data too."""

TRIES = 3
"""Proposals put to held-out data in a round before the residual is called unexplained."""

MOSTLY = 0.5
"""Share of an effect's variance that must lie within groups for its gain to be taken about their means."""

PARTLY = 0.1
"""Share of an effect's variance within groups from which the end of the loop compares errors about their means.

What warms a stroke by the power lost in it has a quarter of its variance inside strokes, where the evidence is.
"""

REPEATED = 10.0
"""Samples for each value of the force from which its steps are those of the recorder, not of chance."""

WEAK = 1e-6
"""P-value above which an effect must also lower the held-out error by `LEAST_FALL`.

P-values of a few specimens or runs rest on what their scatter is assumed to be; held-out data do not. Of 28 claims
with p above 1e-5 in worlds drawn at random, 9 of the 11 true ones lower it by more, 13 of the 17 false ones by less;
two false ones had a p between 1e-6 and 1e-5.
"""

LEAST_FALL = 0.05
"""Share of the held-out RMSE by which an effect of weak evidence must lower it."""

SURE_OF_CURVE = 1e-5
"""P-value that a free shape must reach which changes the shape of the Stribeck curve or of the aging law.

It does if it acts on one of their coefficients, or by the speed together with another variable. How the whole friction
scatters between runs is estimated; how the coefficients do is not. In 354 worlds drawn at random 11 of 13 false claims
of that kind had larger p-values.
"""

LEAST_SIZE = 2e-4
"""Of the RMS force: the smallest effect that counts. What is smaller may as well be the sensor's nonlinearity."""


# ---------------------------------------------------------------- the verdict, and what could have been seen
NOT_ADJUSTED = 0.05
"""P-value of a channel by itself, not adjusted for the search, below which it is named as what is left."""

EVEN = 0.5
"""Adjusted p-value from which chance is the likelier explanation."""

SAME_ERROR = 1.005
"""Ratio of errors up to which they are equal: effects are fitted by whitened, not by plain, squares."""

HARMLESS = 1.1
"""Ratio of errors up to which an effect inside runs may move what runs differ by, where that is most of the error."""

HALVED = 0.5
"""Ratio of held-out errors below which an effect of weak evidence is sure enough to move what runs differ by."""

LACK_OF_FIT = 0.05
"""P-value of the lack of fit from which the error is called larger than the scatter of repeats."""

UNSTEADY = 0.2
"""Share of an offset by which it may differ from run to run and still be one offset."""

POWER_SOUGHT = 0.8
"""Chance with which the smallest effect is found."""

COUNTED = 1.25
"""Factor on the smallest effect that counts; with a standard error of a fifth it is found with `POWER_SOUGHT`."""

REAL_SHARE = 0.1
"""Of a variable's variance: a share at a level that is a real one."""

CLEARLY = 3.0
"""Times the mean square of finer levels: what varies less between groups does so because it varies within them."""

MATERIAL = 0.02
"""Of the force: scatter between units that would matter if it were an effect."""

LEAST_POWER = 0.3
"""Of the size, with which its margin is taken to grow at least."""

FEW_UNITS = 30
"""Groups of a level below which a sandwich covariance is itself uncertain, and has degrees of freedom of its own."""

LEAST_SPARE_RUNS = 0.5
"""Runs that the model must leave over for their scatter to be known at all."""

NEAR_TESTED_SPEED = 0.05
"""Relative difference within which a speed counts as a tested one."""
