"""The workshop: trains and exports what flies. Needs the `lab` extra; nothing that flies imports it."""
