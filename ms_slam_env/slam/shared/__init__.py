"""What the backends share: features, places seen before, decisions on alignments, states."""
