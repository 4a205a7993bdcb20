"""How good an estimate is: metrics, figures, reports. The only reader of the truth."""
