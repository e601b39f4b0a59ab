"""How a federate elsewhere is reached: one seam (`Link`: a question, an answer), in memory or over Eclipse Zenoh."""
