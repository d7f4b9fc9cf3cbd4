"""Panel, operators, settings and preview: what the artist sees and clicks."""
