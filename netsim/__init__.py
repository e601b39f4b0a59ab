"""The emulated radio: which frames arrive where, how strong, and when."""
