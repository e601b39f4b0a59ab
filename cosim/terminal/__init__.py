"""What a terminal shows during a run or a study: progress, summary, table of vehicles."""
