"""What results look like: one drawing style, figures, and the self-contained HTML report.

Works on plain rows, so that whoever measured them may hand them in.
"""
