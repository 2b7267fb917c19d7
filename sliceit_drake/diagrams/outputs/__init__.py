"""What a run leaves: its log, figures, slice records, series for ParaView."""
