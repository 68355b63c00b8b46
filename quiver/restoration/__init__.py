"""Any method on clips of any size in bounded memory."""
