"""Independent reference of the radio: ns-3.44 in the same scenarios. A development tool; the product does not need it."""
