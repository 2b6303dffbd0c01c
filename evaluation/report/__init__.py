"""The report: page, tables, verdict, data card, ParaView files."""
