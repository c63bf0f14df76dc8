"""Random worlds: an independent simulator of whole campaigns, and sealfit's answers scored against its truth.

`priors` says what is drawn and why, `world` draws it, `effects` holds the hidden effects, `law` the friction
law with effects, `motion` the integrated bristles, `campaign` the files, `true_form` what an analyst who
knows the truth could see, `run` one world from draw to scored record, `score` the comparison, `summary` the
table. Nothing here imports sealfit: it is started as a command, and read through closure.json and the CSV
that `predict` writes.
"""
