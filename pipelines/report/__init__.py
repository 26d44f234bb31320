"""What finished runs show: tables, figures, exports, replays and certificates."""
