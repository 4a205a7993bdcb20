"""Models of what is measured, one file a measurement kind: equations and parameters together."""
