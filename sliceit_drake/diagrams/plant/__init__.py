"""What moves and what is touched: arm, knife, board, table and holder in a multibody plant."""
