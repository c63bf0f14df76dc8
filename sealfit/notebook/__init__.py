"""Results as a notebook reads them: tables, plots, predictions and lifetimes, each when it is asked for."""
