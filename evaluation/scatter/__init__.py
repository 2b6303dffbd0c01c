"""What scatter of the parameters does to fields and numbers: arrays in, arrays out; no model is known here."""
