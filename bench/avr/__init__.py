"""Single filters, and the whole firmware in service, on simulated AVR boards."""
