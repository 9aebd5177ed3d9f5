"""Files in the layouts of models that cannot be redistributed, made from our own shape space."""
