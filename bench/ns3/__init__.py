"""The outside judge of the radio: ns-3.44 in the same scenarios. A development tool that nothing else needs."""
